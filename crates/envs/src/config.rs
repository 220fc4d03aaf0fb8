//! Tables of a config file: their defaults, and checks of their values.

use serde::Serialize;
use serde::de::DeserializeOwned;

/// A closed range `[low, high]`.
pub type Range = [f32; 2];

/// A setting is outside its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`{field}` = {value} is not allowed: {allowed}")]
pub struct ConfigError {
    /// The key.
    pub field: String,
    /// Its value.
    pub value: String,
    /// The allowed values.
    pub allowed: String,
}

impl ConfigError {
    /// Returns the error of the same key in the table `table` of the task.
    pub(crate) fn within(self, table: &str) -> Self {
        Self { field: self.field.replacen("task.", &format!("task.{table}."), 1), ..self }
    }
}

/// Checks that a value is within `low..=high`.
pub fn check_value(field: &str, value: f32, low: f32, high: f32) -> Result<(), ConfigError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(ConfigError { field: field.to_owned(), value: value.to_string(), allowed: format!("{low} to {high}") })
}

/// Checks that a range is not reversed, and that both ends are within `low..=high`.
pub fn check_range(field: &str, range: Range, low: f32, high: f32) -> Result<(), ConfigError> {
    if range[0] <= range[1] && low <= range[0] && range[1] <= high {
        return Ok(());
    }
    let allowed = format!("[low, high] with low <= high, both within {low} to {high}");
    Err(ConfigError { field: field.to_owned(), value: format!("{range:?}"), allowed })
}

/// Returns `defaults` with the values of `table`.
///
/// A table within it, such as `walk.reward` of a task, replaces only the keys that it has, whatever the defaults of its type are.
pub fn over_defaults<T: Serialize + DeserializeOwned>(defaults: &T, table: toml::Table) -> Result<T, String> {
    let mut settings = toml::Table::try_from(defaults).map_err(|error| error.to_string())?;
    replace(&mut settings, table);
    settings.try_into().map_err(|error: toml::de::Error| error.to_string().trim_end().to_owned())
}

/// Replaces the values of `settings` that `table` has, table by table.
fn replace(settings: &mut toml::Table, table: toml::Table) {
    for (key, value) in table {
        match (settings.get_mut(&key), value) {
            (Some(toml::Value::Table(settings)), toml::Value::Table(table)) => replace(settings, table),
            (_, value) => drop(settings.insert(key, value)),
        }
    }
}
