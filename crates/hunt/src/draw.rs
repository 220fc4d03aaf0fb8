//! Samples the cases of a blind test. Seed and case number determine everything.

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use twinstep_effects::ModelFile;
use twinstep_effects::{CATALOGUE, Effect, EffectEntry, Scope, Target};
use twinstep_model::{Joint, JointKind, Leg, Stream, go2, standard_normal, stream};

use crate::log_setup::LogSetup;
use crate::mismatch::Mismatch;
use crate::unmodelled::UnmodelledEffect;
use crate::{Plant, Suite};

/// Distance of a missing mass from the trunk's centre, relative to that of an added one: it is missing within the trunk.
const MISSING_MASS_REACH: f64 = 0.25;

/// Kind of a case: what it hides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CaseKind {
    /// One effect of half its prior range or more.
    LargeEffect,
    /// One effect of a fifth of its prior range.
    SmallEffect,
    /// No effect.
    Healthy,
    /// One effect outside the catalogue.
    UnmodelledEffect,
    /// Two effects, each of half its prior range or more.
    TwoEffects,
    /// Four effects, each of half its prior range or more, which may act on the same joints.
    FourEffects,
    /// One effect of a walking robot without motion capture.
    WalkingEffect,
    /// One effect of half its prior range or more that the catalogue lists as a confounder, in a log of positions only.
    ConfusableEffect,
}

/// Number of cases of each kind in a deck of the suite [`Suite::Mixed`], which is then shuffled: 28 cases in rapier, 24 in
/// MuJoCo, for which [`Suite::Healthy`] has the healthy robots.
fn case_mix(plant: Plant) -> &'static [(CaseKind, usize)] {
    match plant {
        Plant::Rapier => &[
            (CaseKind::LargeEffect, 6),
            (CaseKind::SmallEffect, 6),
            (CaseKind::Healthy, 8),
            (CaseKind::UnmodelledEffect, 4),
            (CaseKind::TwoEffects, 4),
        ],
        Plant::Mujoco => &[
            (CaseKind::LargeEffect, 10),
            (CaseKind::SmallEffect, 6),
            (CaseKind::UnmodelledEffect, 4),
            (CaseKind::FourEffects, 4),
        ],
    }
}

/// One case of a blind test.
#[derive(Clone, Debug, PartialEq)]
pub struct Case {
    /// Seed of the blind test.
    pub seed: u64,
    /// Number of the case, from 0.
    pub number: u64,
    /// Kind of the case.
    pub kind: CaseKind,
    /// Base mounting and channels of the log.
    pub setting: LogSetup,
    /// Hidden effects of the catalogue.
    pub hidden: Vec<EffectEntry>,
    /// Hidden effect outside the catalogue.
    pub outside: Option<UnmodelledEffect>,
    /// Errors of a healthy robot of [`Suite::Healthy`].
    pub mismatch: Option<Mismatch>,
}

impl Case {
    /// Samples case `number` of the blind test with this seed.
    pub fn draw(seed: u64, number: u64, plant: Plant, suite: Suite) -> Self {
        let kind = match suite {
            Suite::Mixed => kind(seed, number, plant),
            Suite::Healthy => CaseKind::Healthy,
            Suite::Walking => CaseKind::WalkingEffect,
            Suite::Confusable => CaseKind::ConfusableEffect,
            Suite::Unmodelled => CaseKind::UnmodelledEffect,
        };
        let setting = LogSetup::draw(seed, number, plant, suite);
        let random = &mut stream(seed, "hunt hidden", number);
        let hidden = match kind {
            CaseKind::LargeEffect => vec![from_half(setting, random)],
            CaseKind::SmallEffect => vec![entry(setting, 0.2, random)],
            CaseKind::TwoEffects => two(setting, random),
            CaseKind::FourEffects => four(setting, random),
            CaseKind::Healthy | CaseKind::UnmodelledEffect => Vec::new(),
            CaseKind::WalkingEffect => vec![walking_effect(number, random)],
            CaseKind::ConfusableEffect => vec![confusable(setting, random)],
        };
        let outside = (kind == CaseKind::UnmodelledEffect).then(|| UnmodelledEffect::draw(setting.place, random));
        let family = Mismatch::ALL[(number % Mismatch::ALL.len() as u64) as usize];
        let mismatch = (suite == Suite::Healthy).then_some(family);
        Self { seed, number, kind, setting, hidden, outside, mismatch }
    }

    /// Returns the random stream of this case with this name.
    pub fn stream(&self, name: &str) -> Stream {
        stream(self.seed, name, self.number)
    }

    /// Returns the ground truth as a model file, without an effect outside the catalogue.
    pub fn truth(&self) -> ModelFile {
        ModelFile { effects: self.hidden.clone(), ..ModelFile::default() }
    }
}

fn kind(seed: u64, number: u64, plant: Plant) -> CaseKind {
    let mix = case_mix(plant);
    let mut kinds: Vec<_> = mix.iter().flat_map(|(kind, count)| std::iter::repeat_n(*kind, *count)).collect();
    let size = kinds.len() as u64;
    let random = &mut stream(seed, "hunt deck", number / size);
    // Fisher–Yates shuffle.
    for last in (1..kinds.len()).rev() {
        kinds.swap(last, random.random_range(0..=last));
    }
    kinds[(number % size) as usize]
}

/// Samples an effect with a size of half its prior range to all of it.
fn from_half(setting: LogSetup, random: &mut impl Rng) -> EffectEntry {
    let share = random.random_range(0.5..1.0);
    entry(setting, share, random)
}

/// Samples an effect whose size is `share` of the distance from no effect to the end of its prior range.
fn entry(setting: LogSetup, share: f64, random: &mut impl Rng) -> EffectEntry {
    let visible = setting.visible_effects();
    let effect = visible[random.random_range(0..visible.len())];
    let scope = scope(effect.target, random);
    EffectEntry::new(effect, scope, values(effect, share, random)).expect("values of the prior range are allowed")
}

/// Samples two effects that are not confounders of each other and have no joint in common.
fn two(setting: LogSetup, random: &mut impl Rng) -> Vec<EffectEntry> {
    loop {
        let pair = [from_half(setting, random), from_half(setting, random)];
        let [one, other] = &pair;
        let overlap = Joint::ALL.into_iter().any(|joint| one.scope.contains(joint) && other.scope.contains(joint));
        if !overlap && !confounded(one.effect, other.effect) {
            return pair.to_vec();
        }
    }
}

/// Samples four effects of which none is a confounder of another. They may have joints in common.
fn four(setting: LogSetup, random: &mut impl Rng) -> Vec<EffectEntry> {
    let mut entries: Vec<EffectEntry> = Vec::new();
    while entries.len() < 4 {
        let entry = from_half(setting, random);
        if entries.iter().all(|other| !confounded(entry.effect, other.effect)) {
            entries.push(entry);
        }
    }
    entries
}

/// Returns the effect of a walking robot: in turn a payload of a tenth of the trunk's mass, added or missing, Coulomb
/// friction, and a delay.
fn walking_effect(number: u64, random: &mut impl Rng) -> EffectEntry {
    let name = ["payload", "coulomb_friction", "command_delay"][(number % 3) as usize];
    let effect = Effect::named(name).expect("an effect of the catalogue");
    let share = random.random_range(0.5..1.0);
    let mut sizes = values(effect, share, random);
    if name == "payload" {
        let is_added = random.random_bool(0.5);
        sizes[0] = 0.1 * go2().trunk.mass * if is_added { 1.0 } else { -1.0 };
        if !is_added {
            // Without mass outside the trunk, its inertia would not be positive.
            sizes[1..].iter_mut().for_each(|length| *length *= MISSING_MASS_REACH);
        }
    }
    EffectEntry::new(effect, scope(effect.target, random), sizes).expect("values of the prior range are allowed")
}

/// Samples an effect that the catalogue lists as a confounder of another.
fn confusable(setting: LogSetup, random: &mut impl Rng) -> EffectEntry {
    loop {
        let entry = from_half(setting, random);
        if CATALOGUE.into_iter().any(|other| other != entry.effect && confounded(entry.effect, other)) {
            return entry;
        }
    }
}

/// Returns true if the effects are equal, or the catalogue lists one as a confounder of the other.
fn confounded(one: &Effect, other: &Effect) -> bool {
    let lists = |one: &Effect, other: &Effect| one.confounders.iter().any(|item| item.effect == other.name);
    one == other || lists(one, other) || lists(other, one)
}

fn scope(target: Target, random: &mut impl Rng) -> Scope {
    match target {
        Target::Supply => Scope::All,
        Target::Bodies | Target::Imu => Scope::Base,
        Target::Ground => Scope::Ground,
        Target::Joints => match random.random_range(0..20) {
            0..=2 => Scope::All,
            3..=6 => Scope::Kind(JointKind::ALL[random.random_range(0..3)]),
            7..=9 => Scope::Leg(Leg::ALL[random.random_range(0..4)]),
            10 => Scope::Left,
            11 => Scope::Right,
            _ => Scope::Joint(Joint::ALL[random.random_range(0..12)]),
        },
    }
}

/// Returns the parameter values of an effect. The first parameter has the size `share`; the others are sampled.
fn values(effect: &Effect, share: f64, random: &mut impl Rng) -> Vec<f64> {
    let mut values = Vec::new();
    for (index, parameter) in effect.parameters.iter().enumerate() {
        let [low, high] = parameter.prior_range;
        if index > 0 {
            values.extend((0..parameter.count).map(|_| random.random_range(low..high)));
        } else if parameter.count > 1 {
            let way: Vec<_> = (0..parameter.count).map(|_| standard_normal(random)).collect();
            let length = way.iter().map(|part| part * part).sum::<f64>().sqrt();
            values.extend(way.iter().map(|part| part / length * share * high));
        } else if parameter.no_effect_value.is_infinite() {
            // A limit or a stiffness: its size is its inverse, which is 0 for no effect.
            values.push(low / share);
        } else {
            values.push(
                parameter.no_effect_value
                    + share * (far_end(parameter.no_effect_value, [low, high], random) - parameter.no_effect_value),
            );
        }
    }
    values
}

/// Returns the end of the range that is farther from the no-effect value; a random end if both are equally far.
fn far_end(neutral: f64, [low, high]: [f64; 2], random: &mut impl Rng) -> f64 {
    let (down, up) = (neutral - low, high - neutral);
    let downwards = if (down - up).abs() < 1e-9 { random.random_bool(0.5) } else { down > up };
    if downwards { low } else { high }
}

#[cfg(test)]
mod tests {
    use twinstep_effects::CATALOGUE;
    use twinstep_effects::apply_effects;
    use twinstep_model::go2;

    use super::*;
    use crate::base_schedule::{BaseSchedule, LogLength};

    #[test]
    fn every_effect_but_four_can_be_hidden() {
        let excluded = CATALOGUE.iter().filter(|effect| effect.blind_test.is_none()).map(|effect| effect.name);
        assert_eq!(excluded.collect::<Vec<_>>(), ["pd_gain", "torque_dead_zone", "inertia", "ground_friction"]);
    }

    #[test]
    fn two_hundred_cases_have_the_stated_mix() {
        let count = |kind| (0..200).filter(|number| super::kind(3, *number, Plant::Rapier) == kind).count();
        assert!(count(CaseKind::Healthy) >= 50, "a quarter");
        assert!(count(CaseKind::TwoEffects) >= 28 && count(CaseKind::UnmodelledEffect) >= 28, "a seventh");
        assert!(count(CaseKind::LargeEffect) >= 40 && count(CaseKind::SmallEffect) >= 40);
    }

    #[test]
    fn healthy_robots_of_each_family_have_logs_of_every_length() {
        let cases: Vec<Case> = (0..72).map(|number| Case::draw(3, number, Plant::Mujoco, Suite::Healthy)).collect();
        for family in Mismatch::ALL {
            let of = |length| {
                cases.iter().filter(|case| case.mismatch == Some(family) && case.setting.length == length).count()
            };
            assert_eq!([LogLength::TenSeconds, LogLength::Standard, LogLength::FiveMinutes].map(of), [2, 6, 1]);
        }
    }

    #[test]
    fn walking_robots_have_each_effect_in_turn_and_no_motion_capture() {
        for number in 0..30 {
            let case = Case::draw(5, number, Plant::Mujoco, Suite::Walking);
            assert!(!case.setting.motion_capture && case.setting.place == BaseSchedule::Walking);
            let entry = &case.hidden[0];
            let names = ["payload", "coulomb_friction", "command_delay"];
            assert_eq!(entry.effect.name, names[(number % 3) as usize]);
            if entry.effect.name == "payload" {
                assert!((entry.values[0].abs() - 0.1 * go2().trunk.mass).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn seed_and_number_determine_the_case() {
        let cases =
            |seed| (0..20).map(|number| Case::draw(seed, number, Plant::Rapier, Suite::Mixed)).collect::<Vec<_>>();
        assert_eq!(cases(5), cases(5));
        assert_ne!(cases(5), cases(6));
    }

    #[test]
    fn every_case_is_a_valid_robot_with_visible_effects() {
        let kinds = [
            (Plant::Rapier, Suite::Mixed),
            (Plant::Mujoco, Suite::Mixed),
            (Plant::Mujoco, Suite::Healthy),
            (Plant::Mujoco, Suite::Walking),
            (Plant::Mujoco, Suite::Confusable),
            (Plant::Mujoco, Suite::Unmodelled),
        ];
        for (number, (plant, suite)) in (0..300).flat_map(|number| kinds.map(|kind| (number, kind))) {
            let case = Case::draw(1, number, plant, suite);
            apply_effects(&go2(), &case.hidden).expect("a valid robot");
            let visible = case.setting.visible_effects();
            assert!(case.hidden.iter().all(|entry| visible.contains(&entry.effect)), "{case:?}");
            let hidden = match case.kind {
                CaseKind::LargeEffect
                | CaseKind::SmallEffect
                | CaseKind::WalkingEffect
                | CaseKind::ConfusableEffect => 1,
                CaseKind::TwoEffects => 2,
                CaseKind::FourEffects => 4,
                CaseKind::Healthy | CaseKind::UnmodelledEffect => 0,
            };
            assert_eq!((case.hidden.len(), case.outside.is_some()), (hidden, case.kind == CaseKind::UnmodelledEffect));
        }
    }

    #[test]
    fn size_is_relative_to_the_distance_from_no_effect() {
        let random = &mut stream(0, "test", 0);
        let mut of = |name: &str| values(Effect::named(name).expect("known"), 0.2, random)[0];
        assert!((of("coulomb_friction") - 0.3).abs() < 1e-12);
        assert!((of("payload") - 0.8).abs() < 1e-12, "towards the longer side");
        assert!((of("torque_saturation") - 75.0).abs() < 1e-12);
        assert!(((of("torque_gain") - 1.0).abs() - 0.04).abs() < 1e-12);
    }
}
