//! Text and numbers for an HTML page.

/// Escapes `text` for any place in a page, including quoted attributes.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            // Browsers ignore control characters or report an error.
            control if control.is_control() && control != '\n' => escaped.push(' '),
            other => escaped.push(other),
        }
    }
    escaped
}

/// Formats a number with three significant digits and a typographic minus sign.
pub fn number(value: f64) -> String {
    if value.is_nan() {
        return "–".to_owned();
    }
    if value.is_infinite() {
        return if value > 0.0 { "∞" } else { "−∞" }.to_owned();
    }
    if value == 0.0 {
        return "0".to_owned();
    }
    let digits = value.abs().log10().floor();
    let text = if (-5.0..6.0).contains(&digits) {
        format!("{value:.*}", (2.0 - digits).clamp(0.0, 7.0) as usize)
    } else {
        format!("{value:.2e}")
    };
    text.replace('-', "−")
}

/// Formats numbers for comparison: all with the decimals that the largest needs.
pub fn alike<const N: usize>(values: [f64; N]) -> [String; N] {
    let largest =
        values.into_iter().filter(|value| value.is_finite()).fold(0.0, |most: f64, value| most.max(value.abs()));
    let decimals = 2.0 - largest.log10().floor();
    // Very large, very small and missing numbers are formatted one by one.
    if !(0.0..=7.0).contains(&decimals) {
        return values.map(number);
    }
    let decimals = decimals as usize;
    values.map(|value| if value.is_finite() { format!("{value:.decimals$}").replace('-', "−") } else { number(value) })
}

/// Formats a fraction in percent.
pub fn percent(share: f64) -> String {
    if share.is_finite() { format!("{:.0} %", 100.0 * share).replace('-', "−") } else { "–".to_owned() }
}

/// Returns a bar from 0 to a fraction of the full width.
pub fn bar(share: f64, class: &str) -> String {
    let width = if share.is_finite() { 100.0 * share.clamp(0.0, 1.0) } else { 0.0 };
    format!("<span class=\"bar\"><span class=\"{class}\" style=\"width:{width:.1}%\"></span></span>")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escaped_text_is_never_markup() {
        assert_eq!(escape("<b a='\"&"), "&lt;b a=&#39;&quot;&amp;");
        assert_eq!(escape("a\u{0}b"), "a b");
    }

    #[test]
    fn numbers_have_three_significant_digits() {
        let formatted = [0.0, 1.0, -0.012_345, 412.3, 41_234.0, 1e-9, f64::INFINITY, f64::NAN].map(number);
        assert_eq!(formatted, ["0", "1.00", "−0.0123", "412", "41234", "1.00e−9", "∞", "–"]);
    }

    #[test]
    fn compared_numbers_have_the_same_decimals() {
        assert_eq!(alike([1.0, 0.94, 1.06]), ["1.00", "0.94", "1.06"]);
        assert_eq!(alike([0.002, f64::NEG_INFINITY, f64::NAN]), ["0.00200", "−∞", "–"]);
        assert_eq!(alike([0.0, 41_234.0]), ["0", "41234"]);
    }

    #[test]
    fn bars_are_at_most_as_wide_as_their_box() {
        assert!(bar(7.0, "gain").contains("width:100.0%"));
        assert!(bar(f64::NAN, "gain").contains("width:0.0%"));
    }
}
