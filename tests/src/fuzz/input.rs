//! Inputs of a format by index.

use rand::RngExt;
use twinstep_model::stream;

use super::files::compressed;
use super::format::Format;
use super::mutation::mutate;
use super::{log_examples, weights_examples};

/// Examples of a format, from which its inputs are made.
pub struct Corpus {
    format: Format,
    examples: Vec<Vec<u8>>,
    /// Examples from which parts are copied, and of which one in 16 inputs is a changed copy.
    others: Vec<Vec<u8>>,
}

impl Corpus {
    /// Reads the examples of a format.
    pub fn new(format: Format) -> Self {
        let similar = |other: &Format| match format {
            Format::Wire(_) => other.is_message(),
            Format::Urdf | Format::Mjcf => matches!(other, Format::Urdf | Format::Mjcf),
            Format::Model | Format::Config => matches!(other, Format::Model | Format::Config),
            Format::Parquet | Format::Mcap => matches!(other, Format::Parquet | Format::Mcap),
            Format::Ensemble | Format::Training => matches!(other, Format::Ensemble | Format::Training),
            own => *other == own,
        };
        let others = Format::all().into_iter().filter(similar).flat_map(Format::examples).collect();
        Self { format, examples: format.examples(), others }
    }

    /// Returns input `index` of a seed.
    pub fn input(&self, seed: u64, index: u64) -> Vec<u8> {
        let mut random = stream(seed, self.format.name(), index);
        let pool = if random.random_range(0..16) == 0 { &self.others } else { &self.examples };
        let base = &pool[random.random_range(0..pool.len())];
        match self.format {
            // A change of compressed bytes seldom passes the checksum, so that half of the changes come before.
            Format::CsvGz if random.random() => {
                let csv = log_examples::csv();
                compressed(&mutate(&mut random, &csv, std::slice::from_ref(&csv), true))
            }
            // Words of the header are changed together with its length.
            Format::Ensemble | Format::Training | Format::Policy if random.random_range(0..4) > 0 => {
                let (header, data) = weights_examples::header_and_data(base);
                weights_examples::with_header(&mutate(&mut random, header, &[header.to_vec()], true), data)
            }
            format => mutate(&mut random, base, &self.others, format.is_text()),
        }
    }
}
