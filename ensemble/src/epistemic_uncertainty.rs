//! Epistemic uncertainty of an ensemble, as a divergence between its members.
//!
//! U2E derives it as the information gain of a measurement (§III-B, equations 6 to 8) and computes it as the
//! Jensen–Rényi divergence of order two (equations 9 to 11). Both functions here take one entry per member and weight
//! all members equally. With torques in \[N·m], variances are in \[N²·m²]. The value does not depend on the unit.

/// Returns the Jensen–Rényi divergence of order two of equally weighted Gaussians [nat], as in U2E.
///
/// U2E §III-B, equations (9) to (11): −log Σᵢⱼ wᵢwⱼZᵢⱼ + Σᵢ wᵢ log Zᵢᵢ, where Zᵢⱼ is the density of 𝒩(0, σᵢ² + σⱼ²) at
/// μᵢ − μⱼ. At most ln M. U2E states that it is ≥ 0, and 0 only for equal members. Both hold only for equal variances.
/// With unequal variances it has no lower bound, because this entropy is not concave: two Gaussians of equal mean with
/// σ = 1 and 0.01 have −0.954. [`epistemic_uncertainty`] does not have this defect.
///
/// # Panics
/// If there is no member, or the slices have different lengths.
pub fn jensen_renyi(means: &[f64], variances: &[f64]) -> f64 {
    let own = variances.iter().map(|variance| log_overlap(0.0, 2.0 * variance)).sum::<f64>() / means.len() as f64;
    own - log_mean_over_pairs(means, variances, |_, _| 0.0)
}

/// Returns the epistemic uncertainty of equally weighted Gaussians [nat]: 0 only for equal members, at most ln M.
///
/// Like [`jensen_renyi`] with every Zᵢⱼ divided by √(ZᵢᵢZⱼⱼ): −log Σᵢⱼ wᵢwⱼ Zᵢⱼ/√(ZᵢᵢZⱼⱼ). By the Cauchy–Schwarz
/// inequality no ratio exceeds one, and it is one only for equal Gaussians, which gives both bounds. For equal
/// variances it is U2E's value.
///
/// # Panics
/// If there is no member, or the slices have different lengths.
pub fn epistemic_uncertainty(means: &[f64], variances: &[f64]) -> f64 {
    let own = |member: usize| log_overlap(0.0, 2.0 * variances[member]);
    // Rounding can make the result of equal members slightly negative.
    (-log_mean_over_pairs(means, variances, |one, other| 0.5 * (own(one) + own(other)))).max(0.0)
}

/// Returns log Z (eq. 10), the logarithm of the integral of the product of two Gaussians.
///
/// `difference` is the difference of their means, `variance` the sum of their variances.
fn log_overlap(difference: f64, variance: f64) -> f64 {
    -0.5 * ((std::f64::consts::TAU * variance).ln() + difference * difference / variance)
}

/// Returns the logarithm of the mean over all pairs of Zᵢⱼ·exp(−less(i, j)).
///
/// Computed relative to the largest term, because Z underflows for members that are far apart.
fn log_mean_over_pairs(means: &[f64], variances: &[f64], less: impl Fn(usize, usize) -> f64) -> f64 {
    assert_eq!(means.len(), variances.len(), "one mean and one variance per member");
    assert!(!means.is_empty(), "an ensemble has at least one member");
    let members = 0..means.len();
    let term = |i: usize, j: usize| log_overlap(means[i] - means[j], variances[i] + variances[j]) - less(i, j);
    let pairs = || members.clone().flat_map(|i| members.clone().map(move |j| (i, j)));
    let largest = pairs().map(|(i, j)| term(i, j)).fold(f64::NEG_INFINITY, f64::max);
    let sum: f64 = pairs().map(|(i, j)| (term(i, j) - largest).exp()).sum();
    largest + sum.ln() - 2.0 * (means.len() as f64).ln()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn check(value: f64, expected: f64) {
        assert!((value - expected).abs() < 1e-5, "{value} is not {expected}");
    }

    #[test]
    fn equal_members_have_zero_and_six_distant_ones_log_six() {
        check(jensen_renyi(&[0.3; 6], &[0.7; 6]), 0.0);
        assert!(epistemic_uncertainty(&[0.3; 6], &[0.7; 6]) < 1e-12);
        let far = [0.0, 1e3, 2e3, 3e3, 4e3, 5e3];
        for euf in [jensen_renyi, epistemic_uncertainty] {
            check(euf(&far, &[1.0; 6]), 6f64.ln());
            // exp(-1e12) would underflow.
            check(euf(&far, &[1e-6; 6]), 6f64.ln());
        }
    }

    #[test]
    fn two_groups_of_members_have_the_known_values() {
        for (apart, expected) in [(0.5, 0.03076), (1.0, 0.11721), (2.0, 0.37989), (5.0, 0.69122)] {
            let means = [0.0, 0.0, 0.0, apart, apart, apart];
            check(jensen_renyi(&means, &[1.0; 6]), expected);
            check(epistemic_uncertainty(&means, &[1.0; 6]), expected);
        }
    }

    #[test]
    fn divergence_of_the_paper_is_negative_for_unequal_variances_and_the_corrected_one_is_not() {
        for (ratio, paper) in [(4.0, 0.02271), (100.0, -0.08812), (1e4, -0.95386), (1e6, -2.0714)] {
            check(jensen_renyi(&[0.0; 2], &[1.0, ratio]), paper);
            assert!(epistemic_uncertainty(&[0.0; 2], &[1.0, ratio]) > 0.05);
        }
        let one_of_six = |deviation: f64| jensen_renyi(&[0.0; 6], &[1.0, 1.0, 1.0, 1.0, 1.0, deviation * deviation]);
        assert!(one_of_six(3.6) > 0.0 && one_of_six(3.7) < 0.0);
    }

    #[test]
    fn divergence_is_the_mixture_entropy_minus_the_mean_entropy() {
        let (means, variances) = ([0.2, -0.4, 1.1], [0.3, 0.9, 0.5]);
        let density = |member: usize, x: f64| {
            (-0.5 * (x - means[member]).powi(2) / variances[member]).exp()
                / (std::f64::consts::TAU * variances[member]).sqrt()
        };
        let step = 1e-3;
        let integral = |f: &dyn Fn(f64) -> f64| (-20_000..20_000).map(|i| f(f64::from(i) * step)).sum::<f64>() * step;
        let mixture = |x: f64| (0..3).map(|member| density(member, x)).sum::<f64>() / 3.0;
        let entropy = |f: &dyn Fn(f64) -> f64| -integral(&|x| f(x).powi(2)).ln();
        let own = (0..3).map(|member| entropy(&|x| density(member, x))).sum::<f64>() / 3.0;
        assert!((jensen_renyi(&means, &variances) - (entropy(&mixture) - own)).abs() < 1e-9);
    }

    /// Generates means and variances of an ensemble; the variances span twelve decades.
    fn ensemble() -> impl Strategy<Value = Vec<(f64, f64)>> {
        prop::collection::vec((-50.0..50.0, (-6.0..6.0).prop_map(|power: f64| 10f64.powf(power))), 1..9)
    }

    proptest! {
        #[test]
        fn epistemic_uncertainty_is_within_its_bounds(members in ensemble()) {
            let (means, variances): (Vec<_>, Vec<_>) = members.into_iter().unzip();
            let max = (means.len() as f64).ln() + 1e-12;
            prop_assert!((0.0..=max).contains(&epistemic_uncertainty(&means, &variances)));
            prop_assert!(jensen_renyi(&means, &variances) <= max);
        }

        #[test]
        fn both_are_equal_for_equal_variances(members in ensemble()) {
            let means: Vec<f64> = members.iter().map(|(mean, _)| *mean).collect();
            let variances = vec![members[0].1; means.len()];
            prop_assert!((epistemic_uncertainty(&means, &variances) - jensen_renyi(&means, &variances)).abs() < 1e-9);
        }

        #[test]
        fn value_does_not_depend_on_unit_origin_or_order(members in ensemble(), scale in 0.1..10.0, shift in -9.0..9.0) {
            let (means, variances): (Vec<_>, Vec<_>) = members.iter().copied().unzip();
            let transformed = members.iter().rev().map(|(mean, variance)| (scale * mean + shift, scale * scale * variance));
            let (other_means, other_variances): (Vec<_>, Vec<_>) = transformed.unzip();
            for euf in [jensen_renyi, epistemic_uncertainty] {
                let (one, other) = (euf(&means, &variances), euf(&other_means, &other_variances));
                // Shifting means in the tens that differ by less than one in a thousand loses digits.
                prop_assert!((one - other).abs() < 1e-6, "{one} {other}");
            }
        }
    }
}
