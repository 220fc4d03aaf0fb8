//! What is hidden in a case; everything follows from the seed of the game and the case's number.

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, EffectEntry, Scope, Target};
use twinstep_model::{Joint, JointKind, Leg, Stream, standard_normal, stream};

use crate::unmodelled::UnmodelledEffect;

/// What a case hides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CaseKind {
    /// One effect, from half of its plausible range on.
    LargeEffect,
    /// One effect, at a fifth of its plausible range.
    SmallEffect,
    /// Nothing.
    Healthy,
    /// Something that the catalogue does not have.
    UnmodelledEffect,
    /// Two effects, each from half of its plausible range on.
    TwoEffects,
}

/// How often each kind comes in a shuffled deck, so that any 28 cases in a row from a multiple of 28 have the same mix.
const CASE_MIX: [(CaseKind, usize); 5] = [
    (CaseKind::LargeEffect, 6),
    (CaseKind::SmallEffect, 6),
    (CaseKind::Healthy, 8),
    (CaseKind::UnmodelledEffect, 4),
    (CaseKind::TwoEffects, 4),
];

/// Where the robot moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BaseSchedule {
    /// The base is fixed.
    Fixed,
    /// The robot stands.
    Floating,
    /// First one, then the other.
    FixedThenFloating,
}

/// What the log will have, whatever is hidden.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogSetup {
    /// Where the robot moves.
    pub place: BaseSchedule,
    /// Whether the motors' current was measured.
    pub torque: bool,
    /// Whether the supply's voltage was measured.
    pub battery: bool,
    /// Whether the motors' temperatures were measured.
    pub temperature: bool,
}

/// What an effect needs to show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Requirement {
    /// Legs that are free to move fast, creep and step.
    Air,
    /// Feet on the ground.
    Ground,
    Torque,
    Battery,
    Temperature,
}

/// What each effect needs to show. Not drawn are `inertia`, ten numbers that are another way to say payload and shift,
/// and `ground_friction`: no foot slips in these motions.
const NEEDS: [(&str, &[Requirement]); 25] = [
    ("command_delay", &[Requirement::Air]),
    ("encoder_offset", &[Requirement::Ground]),
    ("pd_gain", &[Requirement::Torque, Requirement::Air]),
    ("torque_saturation", &[Requirement::Air]),
    ("supply_sag", &[Requirement::Battery]),
    ("thermal_derating", &[Requirement::Temperature, Requirement::Air]),
    ("torque_delay", &[Requirement::Air]),
    ("torque_speed_limit", &[Requirement::Air]),
    ("torque_dead_zone", &[Requirement::Torque, Requirement::Air]),
    ("drive_lag", &[Requirement::Air]),
    ("torque_sensor_delay", &[Requirement::Torque, Requirement::Air]),
    ("torque_gain", &[Requirement::Air]),
    ("torque_ripple", &[Requirement::Air]),
    ("backlash", &[Requirement::Air]),
    ("joint_elasticity", &[Requirement::Air]),
    ("coulomb_friction", &[Requirement::Air]),
    ("viscous_friction", &[Requirement::Air]),
    ("stribeck_friction", &[Requirement::Air]),
    ("load_friction", &[Requirement::Ground]),
    ("armature", &[Requirement::Air]),
    ("joint_spring", &[Requirement::Air]),
    ("payload", &[Requirement::Ground]),
    ("com_shift", &[Requirement::Ground]),
    ("ground_stiffness", &[Requirement::Ground]),
    ("gyro_bias", &[Requirement::Ground]),
];

/// One round of the game.
#[derive(Clone, Debug, PartialEq)]
pub struct Case {
    /// Of the game.
    pub seed: u64,
    /// Of the case, from 0.
    pub number: u64,
    /// What it hides.
    pub kind: CaseKind,
    /// What the log will have.
    pub setting: LogSetup,
    /// Hidden effects of the catalogue.
    pub hidden: Vec<EffectEntry>,
    /// What else is hidden.
    pub outside: Option<UnmodelledEffect>,
}

impl Case {
    /// Case `number` of the game with this seed.
    pub fn draw(seed: u64, number: u64) -> Self {
        let kind = kind(seed, number);
        let setting = setting(&mut stream(seed, "hunt setting", number));
        let random = &mut stream(seed, "hunt hidden", number);
        let hidden = match kind {
            CaseKind::LargeEffect => vec![from_half(setting, random)],
            CaseKind::SmallEffect => vec![entry(setting, 0.2, random)],
            CaseKind::TwoEffects => two(setting, random),
            CaseKind::Healthy | CaseKind::UnmodelledEffect => Vec::new(),
        };
        let outside = (kind == CaseKind::UnmodelledEffect).then(|| UnmodelledEffect::draw(setting.place, random));
        Self { seed, number, kind, setting, hidden, outside }
    }

    /// The named random stream of this case.
    pub fn stream(&self, name: &str) -> Stream {
        stream(self.seed, name, self.number)
    }

    /// The true effects in our own model; of what is outside the catalogue it has nothing.
    pub fn truth(&self) -> ModelFile {
        ModelFile { effects: self.hidden.clone(), ..ModelFile::default() }
    }
}

fn kind(seed: u64, number: u64) -> CaseKind {
    let mut deck: Vec<_> = CASE_MIX.iter().flat_map(|(kind, count)| std::iter::repeat_n(*kind, *count)).collect();
    let size = deck.len() as u64;
    let random = &mut stream(seed, "hunt deck", number / size);
    // Fisher and Yates.
    for last in (1..deck.len()).rev() {
        deck.swap(last, random.random_range(0..=last));
    }
    deck[(number % size) as usize]
}

fn setting(random: &mut impl Rng) -> LogSetup {
    let place = match random.random_range(0.0..1.0) {
        share if share < 0.35 => BaseSchedule::Fixed,
        share if share < 0.45 => BaseSchedule::Floating,
        _ => BaseSchedule::FixedThenFloating,
    };
    LogSetup {
        place,
        torque: random.random_bool(0.7),
        battery: random.random_bool(0.5),
        temperature: random.random_bool(0.5),
    }
}

impl LogSetup {
    fn has(self, need: Requirement) -> bool {
        match need {
            Requirement::Air => self.place != BaseSchedule::Floating,
            Requirement::Ground => self.place != BaseSchedule::Fixed,
            Requirement::Torque => self.torque,
            Requirement::Battery => self.battery,
            Requirement::Temperature => self.temperature,
        }
    }

    /// Effects that a log of this setting can show.
    fn shown(self) -> Vec<&'static Effect> {
        let shown = NEEDS.iter().filter(|(_, needs)| needs.iter().all(|need| self.has(*need)));
        shown.map(|(name, _)| Effect::named(name).expect("in the catalogue")).collect()
    }
}

/// An effect with a size of half of its plausible range to all of it.
fn from_half(setting: LogSetup, random: &mut impl Rng) -> EffectEntry {
    let share = random.random_range(0.5..1.0);
    entry(setting, share, random)
}

/// An effect at `share` of the way from nothing to the end of what is plausible.
fn entry(setting: LogSetup, share: f64, random: &mut impl Rng) -> EffectEntry {
    let shown = setting.shown();
    let effect = shown[random.random_range(0..shown.len())];
    let scope = scope(effect.target, random);
    EffectEntry::new(effect, scope, values(effect, share, random)).expect("plausible values are allowed")
}

/// Two effects that are not taken for each other and meet at no joint.
fn two(setting: LogSetup, random: &mut impl Rng) -> Vec<EffectEntry> {
    loop {
        let pair = [from_half(setting, random), from_half(setting, random)];
        let [one, other] = &pair;
        let meet = Joint::ALL.into_iter().any(|joint| one.scope.contains(joint) && other.scope.contains(joint));
        let confused = |one: &Effect, other: &Effect| one.confounders.iter().any(|like| like.effect == other.name);
        let alike =
            one.effect == other.effect || confused(one.effect, other.effect) || confused(other.effect, one.effect);
        if !meet && !alike {
            return pair.to_vec();
        }
    }
}

fn scope(target: Target, random: &mut impl Rng) -> Scope {
    match target {
        Target::Supply => Scope::All,
        Target::Bodies | Target::Base => Scope::Base,
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

/// The first parameter is the effect's size; the others are anywhere in what is plausible.
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
            // A limit or a stiffness: what counts is its inverse, 0 for none.
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

/// The end of the range that is farther from the neutral value; any of two as far.
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

    #[test]
    fn every_effect_but_inertia_and_ground_friction_can_be_hidden() {
        let known: Vec<_> = NEEDS.iter().map(|(name, _)| *name).collect();
        let left_out = ["inertia", "ground_friction"];
        let catalogue = CATALOGUE.iter().map(|effect| effect.name).filter(|name| !left_out.contains(name));
        assert_eq!(catalogue.collect::<Vec<_>>(), known);
    }

    #[test]
    fn two_hundred_cases_have_the_mix_that_is_promised() {
        let count = |kind| (0..200).filter(|number| super::kind(3, *number) == kind).count();
        assert!(count(CaseKind::Healthy) >= 50, "a quarter");
        assert!(count(CaseKind::TwoEffects) >= 28 && count(CaseKind::UnmodelledEffect) >= 28, "a seventh");
        assert!(count(CaseKind::LargeEffect) >= 40 && count(CaseKind::SmallEffect) >= 40);
    }

    #[test]
    fn same_seed_and_number_draw_the_same_case_and_another_seed_another() {
        let cases = |seed| (0..20).map(|number| Case::draw(seed, number)).collect::<Vec<_>>();
        assert_eq!(cases(5), cases(5));
        assert_ne!(cases(5), cases(6));
    }

    #[test]
    fn every_case_is_a_robot_and_shows_what_it_hides() {
        for number in 0..300 {
            let case = Case::draw(1, number);
            apply_effects(&go2(), &case.hidden).expect("a robot");
            let shown = case.setting.shown();
            assert!(case.hidden.iter().all(|entry| shown.contains(&entry.effect)), "{case:?}");
            let hidden = match case.kind {
                CaseKind::LargeEffect | CaseKind::SmallEffect => 1,
                CaseKind::TwoEffects => 2,
                CaseKind::Healthy | CaseKind::UnmodelledEffect => 0,
            };
            assert_eq!((case.hidden.len(), case.outside.is_some()), (hidden, case.kind == CaseKind::UnmodelledEffect));
        }
    }

    #[test]
    fn fifth_of_the_range_is_a_fifth_of_the_way_from_nothing() {
        let random = &mut stream(0, "test", 0);
        let mut of = |name: &str| values(Effect::named(name).expect("known"), 0.2, random)[0];
        assert!((of("coulomb_friction") - 0.3).abs() < 1e-12);
        assert!((of("payload") - 0.8).abs() < 1e-12, "towards the longer side");
        assert!((of("torque_saturation") - 75.0).abs() < 1e-12);
        assert!(((of("torque_gain") - 1.0).abs() - 0.04).abs() < 1e-12);
    }
}
