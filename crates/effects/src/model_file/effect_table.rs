//! Table `[[effect]]` of a model file: an entry, read from TOML and written to it.

use std::fmt::Write as _;

use toml::{Table, Value};

use super::error::EffectEntryError;
use crate::{Effect, EffectEntry, Parameter, Scope, UnknownScope};

/// Interval of a component that was not measured, in a vector with measured components.
const UNBOUNDED: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

/// Content of a table `[[effect]]`, before its scope is understood.
pub struct EffectTable {
    pub effect: &'static Effect,
    pub scope: String,
    /// Values of all parameters.
    pub values: Vec<f64>,
    /// 95 % interval of each value.
    pub intervals: Vec<Option<[f64; 2]>>,
}

/// Reads a table.
pub fn read_table(table: &Table) -> Result<EffectTable, EffectEntryError> {
    let text = |key: &str| match table.get(key) {
        Some(Value::String(text)) => Ok(text.clone()),
        other => Err(key_error(key, other, "a string")),
    };
    let given = text("name")?;
    let effect = Effect::named(&given).ok_or(EffectEntryError::Unknown { given })?;
    let known = |key: &str| effect.parameters.iter().any(|parameter| parameter.name == key);
    if let Some(key) = table.keys().find(|key| !["name", "scope", "interval"].contains(&key.as_str()) && !known(key)) {
        return Err(EffectEntryError::UnknownKey { effect: effect.name, key: key.clone() });
    }
    let scope = text("scope")?;
    let mut values = Vec::new();
    for parameter in effect.parameters {
        values.extend(read_numbers(parameter.name, table.get(parameter.name), parameter.count)?);
    }
    Ok(EffectTable { effect, scope, values, intervals: read_intervals(effect, table.get("interval"))? })
}

/// Reads an entry of a quadruped.
pub fn read_entry(table: &Table) -> Result<EffectEntry, EffectEntryError> {
    let EffectTable { effect, scope, values, intervals } = read_table(table)?;
    let scope: Scope = scope.parse().map_err(|_: UnknownScope| {
        let expected = "one of all, hip, thigh, calf, FL, FR, RL, RR, left, right, base, ground, or a joint such \
                            as FL_hip";
        key_error("scope", table.get("scope"), expected)
    })?;
    Ok(EffectEntry { intervals, ..EffectEntry::new(effect, scope, values)? })
}

fn read_intervals(effect: &'static Effect, given: Option<&Value>) -> Result<Vec<Option<[f64; 2]>>, EffectEntryError> {
    let table = match given {
        None => return Ok(vec![None; effect.num_values()]),
        Some(Value::Table(table)) => table,
        other => return Err(key_error("interval", other, "a table such as { torque_nm = [0.3, 0.5] }")),
    };
    if let Some(key) = table.keys().find(|key| effect.parameters.iter().all(|parameter| parameter.name != *key)) {
        return Err(EffectEntryError::UnknownKey { effect: effect.name, key: format!("interval.{key}") });
    }
    let mut intervals = Vec::new();
    for Parameter { name, count, .. } in effect.parameters {
        let key = format!("interval.{name}");
        match table.get(*name) {
            None => intervals.extend(vec![None; *count]),
            Some(Value::Array(ends)) if ends.len() == 2 => {
                let [low, high] =
                    [read_numbers(&key, Some(&ends[0]), *count)?, read_numbers(&key, Some(&ends[1]), *count)?];
                for ends in low.into_iter().zip(high).map(|(low, high)| [low, high]) {
                    if let Some(expected) = interval_problem(ends) {
                        return Err(key_error(&key, table.get(*name), expected));
                    }
                    intervals.push(Some(ends).filter(|ends| *ends != UNBOUNDED));
                }
            }
            other => return Err(key_error(&key, other, "[low, high]")),
        }
    }
    Ok(intervals)
}

/// Returns what is expected of an interval that is not valid, or `None` if it is valid.
fn interval_problem(ends: [f64; 2]) -> Option<&'static str> {
    let [low, high] = ends;
    if !ends.into_iter().all(f64::is_finite) && ends != UNBOUNDED {
        return Some("two finite numbers, or -inf and inf for a component that was not measured");
    }
    (low > high).then_some("low <= high")
}

/// Reads a number, or a list of `count` numbers.
fn read_numbers(key: &str, given: Option<&Value>, count: usize) -> Result<Vec<f64>, EffectEntryError> {
    let number = |value: &Value| match value {
        Value::Float(value) => Some(*value),
        Value::Integer(value) => Some(*value as f64),
        _ => None,
    };
    let numbers = match (given, count) {
        (Some(value), 1) => number(value).map(|value| vec![value]),
        (Some(Value::Array(list)), _) if list.len() == count => list.iter().map(number).collect(),
        _ => None,
    };
    let expected = if count == 1 { "a number".to_owned() } else { format!("a list of {count} numbers") };
    numbers.ok_or_else(|| key_error(key, given, &expected))
}

pub fn key_error(key: &str, found: Option<&Value>, expected: &str) -> EffectEntryError {
    let found = found.map_or("missing".to_owned(), ToString::to_string);
    EffectEntryError::Key { key: key.to_owned(), found, expected: expected.to_owned() }
}

/// Appends the text of an entry. [`read_entry`] reads exactly the same entry from it.
pub fn write_entry(text: &mut String, entry: &EffectEntry) {
    let EffectEntry { effect, scope, values, intervals } = entry.clone();
    write_table(text, &EffectTable { effect, scope: scope.to_string(), values, intervals });
}

/// Appends the text of a table. [`read_table`] reads exactly the same table from it.
pub fn write_table(text: &mut String, table: &EffectTable) {
    let scope = Value::from(table.scope.clone());
    writeln!(text, "\n[[effect]]\nname = \"{}\"\nscope = {scope}", table.effect.name)
        .expect("a String takes every text");
    let mut intervals = Vec::new();
    for (parameter, values) in split_by_parameter(table.effect, &table.values) {
        writeln!(text, "{} = {}", parameter.name, toml_value(values)).expect("a String takes every text");
    }
    for (parameter, values) in split_by_parameter(table.effect, &table.intervals) {
        if values.iter().any(Option::is_some) {
            let ends = values.iter().map(|interval| interval.unwrap_or(UNBOUNDED));
            let [low, high] = [0, 1].map(|end| toml_value(&ends.clone().map(|ends| ends[end]).collect::<Vec<_>>()));
            intervals.push(format!("{} = [{low}, {high}]", parameter.name));
        }
    }
    if !intervals.is_empty() {
        writeln!(text, "interval = {{ {} }}", intervals.join(", ")).expect("a String takes every text");
    }
}

/// Splits the values of an effect by parameter.
fn split_by_parameter<'a, T>(effect: &'static Effect, numbers: &'a [T]) -> Vec<(&'static Parameter, &'a [T])> {
    let mut rest = numbers;
    let split = |parameter: &'static Parameter| {
        let (own, after) = rest.split_at(parameter.count);
        rest = after;
        (parameter, own)
    };
    effect.parameters.iter().map(split).collect()
}

/// Returns a TOML number for one value, and a list for several.
fn toml_value(values: &[f64]) -> Value {
    match values {
        [value] => Value::from(*value),
        values => Value::from(values.to_vec()),
    }
}
