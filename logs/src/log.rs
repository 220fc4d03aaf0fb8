//! A measured log in memory.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use twinstep_model::Joint;

use crate::check::{self, LogKind};
use crate::columns::Column;
use crate::files::{Files, Format};
use crate::meta::{Gain, Meta, Segment};
use crate::table::Table;
use crate::{LogError, csv_table, mcap_file, parquet_table};

/// What a robot was told and what it did, row by row, with everything checked.
///
/// A row's sensors are sampled at its `t`; its commands are in force from `t` to the next row; `tau_measured` is the
/// mean over that interval. Two logs are equal when they describe and hold the same; what was ignored while reading
/// does not count, and a missing cell equals a missing cell.
#[derive(Clone, Debug)]
pub struct Log {
    pub(crate) meta: Meta,
    pub(crate) t: Vec<f64>,
    pub(crate) segment: Vec<u32>,
    pub(crate) episode: Vec<u32>,
    pub(crate) joints: Vec<String>,
    pub(crate) channels: BTreeMap<String, Vec<f64>>,
    pub(crate) ignored: Vec<String>,
    pub(crate) notes: Vec<String>,
}

impl Log {
    /// Reads a log from its folder, or from its data file with the description beside it.
    ///
    /// A folder holds `meta.json` and one of `data.parquet`, `data.csv`, `data.csv.gz` and `data.mcap`. Beside a data
    /// file `walk.csv` is `walk.json`, or `meta.json`. MCAP needs no description: a log that [`Log::write`] wrote
    /// carries its own, and of any other recording one is made of what it holds.
    pub fn open(path: impl AsRef<Path>) -> Result<Log, LogError> {
        read(path.as_ref(), LogKind::Measurement)
    }

    /// Reads a motion: a log that needs command columns only, and no gains.
    ///
    /// A measured log is also a motion.
    pub fn open_commands(path: impl AsRef<Path>) -> Result<Log, LogError> {
        read(path.as_ref(), LogKind::Commands)
    }

    /// Makes a log of columns in memory, checked like a file; a missing cell is NaN.
    pub fn new(meta: Meta, columns: impl IntoIterator<Item = (String, Vec<f64>)>) -> Result<Log, LogError> {
        from_columns(meta, columns, LogKind::Measurement)
    }

    /// Makes a motion of command columns in memory.
    pub fn new_commands(meta: Meta, columns: impl IntoIterator<Item = (String, Vec<f64>)>) -> Result<Log, LogError> {
        from_columns(meta, columns, LogKind::Commands)
    }

    /// What the log says of itself.
    pub fn meta(&self) -> &Meta {
        &self.meta
    }

    /// Time of each row [s]; increases within a segment of an episode.
    pub fn t(&self) -> &[f64] {
        &self.t
    }

    /// For each row, an index into the segments of [`Log::meta`]; zero where the file has no such column.
    pub fn segment(&self) -> &[u32] {
        &self.segment
    }

    /// For each row, a number that changes when the robot was re-placed; zero where the file has no such column.
    pub fn episode(&self) -> &[u32] {
        &self.episode
    }

    /// The joints' names, as the description lists them, or else in the order of their columns.
    pub fn joints(&self) -> &[String] {
        &self.joints
    }

    /// The joints, in the order of [`Log::joints`]; none if a name is not a Go2's.
    pub fn go2_joints(&self) -> Option<Vec<Joint>> {
        self.joints.iter().map(|joint| joint.parse().ok()).collect()
    }

    /// Columns of the file that were left out: unknown names, and joints that the description does not list.
    pub fn ignored(&self) -> &[String] {
        &self.ignored
    }

    /// What was odd about the file and yet no error, in sentences.
    pub fn read_warnings(&self) -> &[String] {
        &self.notes
    }

    /// Number of rows, at least one.
    pub fn rows(&self) -> usize {
        self.t.len()
    }

    /// Recorded time, without the pauses between the parts of [`Log::segments`] [s].
    pub fn duration_s(&self) -> f64 {
        self.segments().map(|(_, rows)| self.t[rows.end - 1] - self.t[rows.start]).sum()
    }

    /// The log's parts: rows that follow one another in one segment of one episode.
    pub fn segments(&self) -> impl Iterator<Item = (&Segment, Range<usize>)> {
        contiguous_ranges(&self.segment, &self.episode).map(|rows| (&self.meta.segments[self.segment[rows.start] as usize], rows))
    }

    /// A channel by its column name, such as `gyro_x`; a missing cell is NaN.
    pub fn channel(&self, name: &str) -> Option<&[f64]> {
        self.channels.get(name).map(Vec::as_slice)
    }

    /// All channels by column name, without `t`, `segment` and `episode`.
    pub fn channels(&self) -> impl Iterator<Item = (&str, &[f64])> {
        self.channels.iter().map(|(name, cells)| (name.as_str(), cells.as_slice()))
    }

    /// Measured position [rad]; only a motion can lack it.
    pub fn q(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("q", joint)
    }

    /// Measured velocity [rad/s].
    pub fn dq(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("dq", joint)
    }

    /// Commanded position [rad].
    pub fn q_cmd(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("q_cmd", joint)
    }

    /// Commanded velocity [rad/s]; zero was commanded where it is absent.
    pub fn dq_cmd(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("dq_cmd", joint)
    }

    /// Torque that was commanded beside the gains [N·m]; zero was commanded where it is absent.
    pub fn tau_ff(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("tau_ff", joint)
    }

    /// Measured torque, at the place that `tau_sensor` of [`Log::meta`] names [N·m].
    pub fn tau_measured(&self, joint: &str) -> Option<&[f64]> {
        self.of_joint("tau_measured", joint)
    }

    /// Position gain in force from a row to the next [N·m/rad]; only a motion can lack it.
    pub fn kp(&self, joint: &str, row: usize) -> Option<f64> {
        self.gain("kp", self.meta.kp.as_ref(), joint, row)
    }

    /// Velocity gain in force from a row to the next [N·m·s/rad]; only a motion can lack it.
    pub fn kd(&self, joint: &str, row: usize) -> Option<f64> {
        self.gain("kd", self.meta.kd.as_ref(), joint, row)
    }

    /// Standard deviation of a channel's noise in the channel's unit, where the description states it.
    pub fn noise(&self, channel: &str) -> Option<f64> {
        let quantity = Column::parse(channel)?.quantity.name;
        self.meta.noise.get(channel).or_else(|| self.meta.noise.get(quantity)).copied()
    }

    fn of_joint(&self, quantity: &str, joint: &str) -> Option<&[f64]> {
        self.channel(&format!("{quantity}_{joint}"))
    }

    fn gain(&self, quantity: &str, constant: Option<&Gain>, joint: &str, row: usize) -> Option<f64> {
        let index = self.joints.iter().position(|name| name == joint)?;
        match self.of_joint(quantity, joint).or_else(|| self.channel(quantity)) {
            Some(column) => column.get(row).copied(),
            None => constant.filter(|_| row < self.rows())?.of(index),
        }
    }

    /// All columns, in the order in which they are written.
    pub(crate) fn columns(&self) -> Vec<NamedColumn<'_>> {
        let mut columns = vec![
            NamedColumn { name: "t".to_owned(), cells: ColumnCells::Number(&self.t) },
            NamedColumn { name: "segment".to_owned(), cells: ColumnCells::Index(&self.segment) },
            NamedColumn { name: "episode".to_owned(), cells: ColumnCells::Index(&self.episode) },
        ];
        let place = |name: &str| {
            let column = Column::parse(name)?;
            Some((column.rank(), self.joints.iter().position(|joint| Some(joint.as_str()) == column.joint())))
        };
        let mut names: Vec<_> = self.channels.keys().collect();
        names.sort_by_key(|name| place(name));
        columns.extend(
            names
                .into_iter()
                .map(|name| NamedColumn { name: name.clone(), cells: ColumnCells::Number(&self.channels[name]) }),
        );
        columns
    }
}

impl PartialEq for Log {
    fn eq(&self, other: &Log) -> bool {
        let same = |mine: &f64, its: &f64| mine == its || (mine.is_nan() && its.is_nan());
        self.meta == other.meta
            && self.joints == other.joints
            && self.t == other.t
            && self.segment == other.segment
            && self.episode == other.episode
            && self.channels.keys().eq(other.channels.keys())
            && self.channels.values().flatten().zip(other.channels.values().flatten()).all(|(a, b)| same(a, b))
    }
}

/// A column as it is written.
pub(crate) struct NamedColumn<'a> {
    pub name: String,
    pub cells: ColumnCells<'a>,
}

/// The cells of a column as it is written.
#[derive(Clone, Copy)]
pub(crate) enum ColumnCells<'a> {
    Index(&'a [u32]),
    Number(&'a [f64]),
}

impl ColumnCells<'_> {
    pub fn len(&self) -> usize {
        match self {
            ColumnCells::Index(cells) => cells.len(),
            ColumnCells::Number(cells) => cells.len(),
        }
    }
}

/// The ranges of rows within which neither segment nor episode changes.
pub(crate) fn contiguous_ranges<'a>(segment: &'a [u32], episode: &'a [u32]) -> impl Iterator<Item = Range<usize>> + use<'a> {
    let rows = segment.len();
    let mut start = 0;
    std::iter::from_fn(move || {
        if start == rows {
            return None;
        }
        let changed = |&row: &usize| segment[row] != segment[start] || episode[row] != episode[start];
        let end = (start + 1..rows).find(changed).unwrap_or(rows);
        let part = start..end;
        start = end;
        Some(part)
    })
}

fn read(path: &Path, need: LogKind) -> Result<Log, LogError> {
    let files = Files::find(path)?;
    let meta = files.meta.as_deref().map(Meta::read).transpose()?;
    let meta_file = files.meta.as_ref().unwrap_or(&files.data);
    let needed = |meta: Option<Meta>| {
        meta.ok_or_else(|| LogError::NoMeta { wanted: files.wanted_meta(), data: files.data.clone() })
    };
    let open = || std::fs::File::open(&files.data).map_err(|cause| LogError::Read { file: files.data.clone(), cause });
    let (table, meta) = match files.format {
        Format::Csv => (csv_table::read(&files.data, open()?)?, needed(meta)?),
        Format::CsvGz => (csv_table::read(&files.data, flate2::read::MultiGzDecoder::new(open()?))?, needed(meta)?),
        Format::Parquet => (parquet_table::read(&files.data)?, needed(meta)?),
        Format::Mcap => mcap_file::read(&files.data, meta)?,
    };
    check::assemble(table, meta, meta_file, need)
}

fn from_columns(
    meta: Meta,
    columns: impl IntoIterator<Item = (String, Vec<f64>)>,
    need: LogKind,
) -> Result<Log, LogError> {
    // What errors call a log that is in no file.
    let here = Path::new("columns in memory");
    meta.check(here)?;
    let (names, cells): (Vec<_>, Vec<_>) = columns.into_iter().unzip();
    let (mut table, places) = Table::from_header(here, &names)?;
    for (cells, place) in cells.into_iter().zip(places) {
        if let Some(place) = place {
            table.columns[place].1 = cells;
        }
    }
    check::assemble(table, meta, here, need)
}
