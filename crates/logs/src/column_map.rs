//! Columns of a file that have other names or units than those of a log.

use std::collections::BTreeMap;
use std::path::Path;
use twinstep_effects::parse_toml;

use serde::Deserialize;

use crate::table::Table;
use crate::{LogError, Meta};

/// A map of columns (TOML): for each column of a log the column of the file that it is read from.
///
/// Keys may have one `*`, which stands for the same text in `column`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct ColumnMap {
    /// Metadata, if the file has none beside it.
    #[serde(default)]
    meta: Option<Meta>,
    #[serde(flatten)]
    columns: BTreeMap<String, Source>,
}

/// Where the cells of a column come from.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged, expecting = "expected the name of a column, or a table with `column`, `unit`, `scale` and `offset`")]
enum Source {
    Name(String),
    Converted(Conversion),
}

/// A column and how its cells are converted: `(cell · scale + offset) · unit`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Conversion {
    /// Column of the file. Default: the key.
    column: Option<String>,
    /// Unit of the cells.
    unit: Option<String>,
    scale: Option<f64>,
    offset: Option<f64>,
}

/// Units with their factors to SI.
const UNITS: [(&str, f64); 18] = [
    ("s", 1.0),
    ("ms", 1e-3),
    ("us", 1e-6),
    ("ns", 1e-9),
    ("rad", 1.0),
    ("deg", std::f64::consts::PI / 180.0),
    ("rev", std::f64::consts::TAU),
    ("rad/s", 1.0),
    ("deg/s", std::f64::consts::PI / 180.0),
    ("rpm", std::f64::consts::PI / 30.0),
    ("Nm", 1.0),
    ("mNm", 1e-3),
    ("m", 1.0),
    ("mm", 1e-3),
    ("m/s", 1.0),
    ("m/s2", 1.0),
    ("g", 9.806_65),
    ("mV", 1e-3),
];

/// A column of a log and how it is made.
struct Target<'a> {
    name: String,
    conversion: Option<&'a Conversion>,
}

impl ColumnMap {
    /// Reads and checks a map.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, LogError> {
        let path = path.as_ref();
        let failed = |reason: String| LogError::ColumnMap { file: path.into(), reason };
        let text = std::fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
        Self::parse(&text).map_err(failed)
    }

    /// Parses and checks the text of a map. The error says what is wrong.
    pub fn parse(text: &str) -> Result<Self, String> {
        let map: Self = parse_toml(text).map_err(|error| error.to_string().trim_end().to_owned())?;
        for (key, source) in &map.columns {
            let Source::Converted(conversion) = source else { continue };
            if let Some(unit) = conversion.unit.as_ref().filter(|unit| !UNITS.iter().any(|(name, _)| name == unit)) {
                let known = UNITS.map(|(name, _)| name).join(", ");
                return Err(format!(
                    "`{key}` has the unit `{unit}`; known units are {known}; for others state `scale`"
                ));
            }
            let numbers = [("scale", conversion.scale), ("offset", conversion.offset)];
            if let Some((name, value)) = numbers.iter().find(|(_, value)| value.is_some_and(|value| !value.is_finite()))
            {
                return Err(format!("`{name}` of `{key}` is {value:?}; a finite number is expected"));
            }
        }
        if let Some(meta) = &map.meta {
            meta.check(Path::new("[meta]")).map_err(|error| error.to_string())?;
        }
        Ok(map)
    }

    /// Returns the metadata.
    pub(crate) fn meta(&self) -> Option<Meta> {
        self.meta.clone()
    }

    /// Returns the names in a log for the names in the header of a file. Fails if the map names a column that is not there.
    pub(crate) fn names(&self, file: &Path, header: &[String]) -> Result<Vec<String>, LogError> {
        for (key, source) in &self.columns {
            let column = column_of(key, source);
            if !header.iter().any(|name| wildcard(column, name).is_some()) {
                let shown: Vec<&str> = header.iter().take(12).map(String::as_str).collect();
                let reason = format!(
                    "`{key}` is to be read from the column `{column}`, which {} does not have; its columns are {}",
                    file.display(),
                    shown.join(", ")
                );
                return Err(LogError::ColumnMap { file: file.into(), reason });
            }
        }
        let taken: Vec<String> = header.iter().filter_map(|name| Some(self.target(name)?.name)).collect();
        let own = |name: &String| match self.target(name) {
            Some(target) => target.name,
            // Another column takes its place.
            None if taken.contains(name) => format!("{name} of the file"),
            None => name.clone(),
        };
        Ok(header.iter().map(own).collect())
    }

    /// Converts the cells of a table whose columns had these names in the file.
    pub(crate) fn convert(&self, header: &[String], table: &mut Table) {
        for target in header.iter().filter_map(|name| self.target(name)) {
            let Some(conversion) = target.conversion else { continue };
            let unit = conversion.unit.as_ref().and_then(|unit| UNITS.iter().find(|(name, _)| name == unit));
            let unit = unit.map_or(1.0, |(_, factor)| *factor);
            let (scale, offset) = (conversion.scale.unwrap_or(1.0), conversion.offset.unwrap_or(0.0));
            let found = table.columns.iter_mut().find(|(name, _)| *name == target.name);
            // Times since 1970 in nanoseconds have more digits than a cell: the first is subtracted before the unit.
            let start = if target.name == "t" && unit < 1.0 {
                found.as_ref().and_then(|(_, cells)| cells.first().copied())
            } else {
                None
            };
            if let Some((_, cells)) = found {
                for cell in cells {
                    *cell = ((*cell - start.unwrap_or(0.0)) * scale + offset) * unit;
                }
            }
        }
    }

    /// Returns the column of a log that is read from a column of the file.
    fn target(&self, header: &str) -> Option<Target<'_>> {
        // A key without `*` comes first.
        let exact = |key: &&String| key.contains('*');
        let mut keys: Vec<&String> = self.columns.keys().collect();
        keys.sort_by_key(exact);
        keys.into_iter().find_map(|key| {
            let source = &self.columns[key];
            let part = wildcard(column_of(key, source), header)?;
            let conversion = if let Source::Converted(conversion) = source { Some(conversion) } else { None };
            Some(Target { name: key.replace('*', part), conversion })
        })
    }
}

fn column_of<'a>(key: &'a str, source: &'a Source) -> &'a str {
    match source {
        Source::Name(name) => name,
        Source::Converted(conversion) => conversion.column.as_deref().unwrap_or(key),
    }
}

/// Returns what `*` stands for if a pattern is the name; nothing for a pattern without `*`.
fn wildcard<'a>(pattern: &str, name: &'a str) -> Option<&'a str> {
    match pattern.split_once('*') {
        None => (pattern == name).then_some(""),
        Some((start, end)) => name.strip_prefix(start)?.strip_suffix(end),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_renamed_and_converted() {
        let map = ColumnMap::parse(
            "t = { column = \"stamp\", unit = \"ns\" }\n\"q_*\" = { column = \"pos_*\", unit = \"deg\" }\nq_FL_calf = \"knee\"\n\
             \"q_cmd_*\" = { scale = 2.0, offset = 1.0 }\n",
        )
        .expect("a map");
        let header = ["stamp", "pos_FL_hip", "knee", "q_cmd_FL_hip", "t"].map(str::to_owned);
        let file = Path::new("file.csv");
        let names = map.names(file, &header).expect("all there");
        assert_eq!(names, ["t", "q_FL_hip", "q_FL_calf", "q_cmd_FL_hip", "t of the file"]);
        let (mut table, _) = Table::from_header(file, &names).expect("columns");
        let cells = [vec![1.7e18, 1.7e18 + 2e6], vec![180.0, 90.0], vec![1.0, 2.0], vec![3.0, 4.0]];
        table.columns.iter_mut().zip(cells).for_each(|((_, column), cells)| *column = cells);
        map.convert(&header, &mut table);
        // A cell has 256 ns at these times.
        assert!((table.column("t").expect("a time")[1] - 0.002).abs() < 3e-7);
        assert_eq!(table.column("q_FL_hip"), Some(&[std::f64::consts::PI, std::f64::consts::FRAC_PI_2][..]));
        assert_eq!(table.column("q_FL_calf"), Some(&[1.0, 2.0][..]));
        assert_eq!(table.column("q_cmd_FL_hip"), Some(&[7.0, 9.0][..]));
    }

    #[test]
    fn errors_name_the_key_and_what_is_there() {
        let error = ColumnMap::parse("t = { unit = \"minutes\" }").expect_err("no such unit");
        assert!(error.contains("`t` has the unit `minutes`; known units are s, ms"), "{error}");
        assert!(
            ColumnMap::parse("t = { colum = \"time\" }").expect_err("a typo").contains("expected the name of a column")
        );
        let map = ColumnMap::parse("t = \"time\"").expect("a map");
        let error = map.names(Path::new("a.csv"), &["stamp".to_owned()]).expect_err("no column").to_string();
        assert!(error.contains("`t` is to be read from the column `time`") && error.contains("stamp"), "{error}");
    }
}
