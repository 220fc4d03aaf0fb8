//! YAML as training programs write it: tags of Python are ignored, the order of keys is kept.

use saphyr_parser::{Event, Parser, ScalarStyle};

/// Most values of a file, with the repetitions by aliases.
const MAX_VALUES: usize = 1 << 20;
/// Deepest nesting.
const MAX_DEPTH: usize = 64;

/// A value.
#[derive(Clone, Debug, PartialEq)]
pub enum Yaml {
    /// Nothing.
    Null,
    /// A truth value.
    Bool(bool),
    /// A number.
    Number(f64),
    /// A text.
    Text(String),
    /// A sequence.
    List(Vec<Yaml>),
    /// Keys and values, in the order of the file.
    Map(Vec<(String, Yaml)>),
}

impl Yaml {
    /// Parses a document.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut reader = Reader { events: Parser::new_from_str(text), anchors: Vec::new(), values: 0 };
        loop {
            match reader.next()? {
                Event::StreamStart | Event::DocumentStart(_) | Event::Nothing => {}
                Event::StreamEnd | Event::DocumentEnd => return Ok(Self::Null),
                event => return reader.value(event, 0),
            }
        }
    }

    /// Returns the value of a key.
    pub fn get(&self, key: &str) -> Option<&Yaml> {
        self.entries().iter().find(|(own, _)| own == key).map(|(_, value)| value).filter(|value| **value != Self::Null)
    }

    /// Returns the value at a path of keys.
    pub fn at(&self, path: &[&str]) -> Option<&Yaml> {
        path.iter().try_fold(self, |value, key| value.get(key))
    }

    /// Returns the entries of a map; of other values none.
    pub fn entries(&self) -> &[(String, Yaml)] {
        if let Self::Map(entries) = self { entries } else { &[] }
    }

    /// Returns the items of a list; of other values none.
    pub fn items(&self) -> &[Yaml] {
        if let Self::List(items) = self { items } else { &[] }
    }

    /// Returns a number.
    pub fn number(&self) -> Option<f64> {
        if let Self::Number(number) = self { Some(*number) } else { None }
    }

    /// Returns a text.
    pub fn text(&self) -> Option<&str> {
        if let Self::Text(text) = self { Some(text) } else { None }
    }

    /// Returns a list of numbers, or the only number.
    pub fn one_or_more(&self) -> Option<Vec<f64>> {
        self.number().map(|number| vec![number]).or_else(|| self.numbers())
    }

    /// Returns a list of numbers.
    pub fn numbers(&self) -> Option<Vec<f64>> {
        if let Self::List(items) = self { items.iter().map(Self::number).collect() } else { None }
    }

    /// Returns a list of texts.
    pub fn texts(&self) -> Option<Vec<String>> {
        if let Self::List(items) = self {
            items.iter().map(|item| item.text().map(str::to_owned)).collect()
        } else {
            None
        }
    }
}

struct Reader<'a> {
    events: Parser<'a, saphyr_parser::StrInput<'a>>,
    anchors: Vec<(usize, Yaml)>,
    values: usize,
}

impl<'a> Reader<'a> {
    fn next(&mut self) -> Result<Event<'a>, String> {
        match self.events.next() {
            Some(Ok((event, _))) => Ok(event),
            Some(Err(error)) => Err(error.to_string()),
            None => Ok(Event::StreamEnd),
        }
    }

    fn value(&mut self, event: Event, depth: usize) -> Result<Yaml, String> {
        self.values += 1;
        if depth > MAX_DEPTH || self.values > MAX_VALUES {
            return Err(format!("it is nested more than {MAX_DEPTH} times, or has more than {MAX_VALUES} values"));
        }
        let (anchor, value) = match event {
            Event::Scalar(text, style, anchor, _) => (anchor, scalar(&text, style)),
            Event::SequenceStart(anchor, _) => (anchor, self.list(depth)?),
            Event::MappingStart(anchor, _) => (anchor, self.map(depth)?),
            Event::Alias(anchor) => {
                let found = self.anchors.iter().find(|(own, _)| *own == anchor).map(|(_, value)| value.clone());
                let value = found.ok_or("an alias has no anchor before it")?;
                self.values += count(&value);
                (0, value)
            }
            _ => return Err("it ends within a value".to_owned()),
        };
        if anchor > 0 {
            self.values += count(&value);
            self.anchors.push((anchor, value.clone()));
        }
        Ok(value)
    }

    fn list(&mut self, depth: usize) -> Result<Yaml, String> {
        let mut items = Vec::new();
        loop {
            match self.next()? {
                Event::SequenceEnd => return Ok(Yaml::List(items)),
                event => items.push(self.value(event, depth + 1)?),
            }
        }
    }

    fn map(&mut self, depth: usize) -> Result<Yaml, String> {
        let mut entries = Vec::new();
        loop {
            let key = match self.next()? {
                Event::MappingEnd => return Ok(Yaml::Map(entries)),
                event => self.value(event, depth + 1)?,
            };
            let key = match key {
                Yaml::Text(text) => text,
                Yaml::Number(number) => number.to_string(),
                Yaml::Bool(value) => value.to_string(),
                _ => "?".to_owned(),
            };
            let event = self.next()?;
            entries.push((key, self.value(event, depth + 1)?));
        }
    }
}

fn scalar(text: &str, style: ScalarStyle) -> Yaml {
    if style != ScalarStyle::Plain {
        return Yaml::Text(text.to_owned());
    }
    match text {
        "" | "~" | "null" | "Null" | "NULL" => Yaml::Null,
        "true" | "True" | "TRUE" => Yaml::Bool(true),
        "false" | "False" | "FALSE" => Yaml::Bool(false),
        // `inf` and `nan` are words, which the parser of Rust takes for numbers.
        _ if text.starts_with(|first: char| first.is_ascii_digit() || "+-.".contains(first)) => {
            let number = text.trim_start_matches('+').parse().ok().or(match text {
                ".inf" | "+.inf" => Some(f64::INFINITY),
                "-.inf" => Some(f64::NEG_INFINITY),
                _ => None,
            });
            number.map_or_else(|| Yaml::Text(text.to_owned()), Yaml::Number)
        }
        _ => Yaml::Text(text.to_owned()),
    }
}

fn count(value: &Yaml) -> usize {
    match value {
        Yaml::List(items) => items.iter().map(count).sum::<usize>() + 1,
        Yaml::Map(entries) => entries.iter().map(|(_, value)| count(value)).sum::<usize>() + 1,
        _ => 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_training_configs_are_read() {
        let text = "a: !!python/tuple\n- 1.0\n- -2\nb: {c: null, d: .5, e: 'x'}\nf: &g [1e-3]\nh: *g\n\
                    i: !!python/object/apply:module.Enum\n- 1\nj: infinite\n";
        let yaml = Yaml::parse(text).expect("valid");
        assert_eq!(yaml.get("a").and_then(Yaml::numbers), Some(vec![1.0, -2.0]));
        assert_eq!(yaml.at(&["b", "c"]), None);
        assert_eq!(yaml.at(&["b", "d"]).and_then(Yaml::number), Some(0.5));
        assert_eq!(yaml.get("h").and_then(Yaml::numbers), Some(vec![0.001]));
        assert_eq!(yaml.get("j").and_then(Yaml::text), Some("infinite"));
    }

    #[test]
    fn aliases_that_multiply_and_deep_nests_are_refused() {
        let mut bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n".to_owned();
        for level in 1..12 {
            let aliases = vec![format!("*a{}", level - 1); 10].join(", ");
            bomb = format!("{bomb}a{level}: &a{level} [{aliases}]\n");
        }
        assert!(Yaml::parse(&bomb).expect_err("too many").contains("more than"));
        assert!(Yaml::parse(&"[".repeat(10_000)).is_err());
    }
}
