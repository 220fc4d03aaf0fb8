//! Examples and reader of each format.

use std::path::Path;

use super::format::{Format, Outcome, examples_in};
use super::{files, log_examples, policies, weights_examples};

impl Format {
    /// Returns valid inputs.
    pub fn examples(self) -> Vec<Vec<u8>> {
        match self {
            Format::Wire(message) => message.examples(),
            Format::Csv => vec![log_examples::csv(), log_examples::commands_csv()],
            Format::CsvGz => vec![files::compressed(&log_examples::csv())],
            Format::Parquet => {
                let of_pandas = examples_in("crates/logs/tests/data", "", ".parquet");
                [of_pandas, vec![log_examples::written("data.parquet")]].concat()
            }
            Format::Mcap => log_examples::mcap(),
            Format::Meta => vec![log_examples::meta().into_bytes()],
            Format::Ensemble => vec![weights_examples::ensemble()],
            Format::Training => vec![weights_examples::training()],
            Format::Bag => vec![log_examples::bag()],
            Format::Policy
            | Format::Onnx
            | Format::Mapping
            | Format::PolicyConfig
            | Format::PolicyConfigPy
            | Format::LowState
            | Format::RpcResponse => policies::examples(self),
            text => files::text_examples(text),
        }
    }

    /// Reads an input as the program does. A panic is a defect.
    pub fn read(self, bytes: &[u8], folder: &Path) -> Outcome {
        match self {
            Format::Wire(message) => message.read(bytes),
            file => files::read(file, bytes, folder),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(format: Format, bytes: &[u8]) -> Outcome {
        let folder = tempfile::tempdir().expect("a temporary folder");
        format.read(bytes, folder.path())
    }

    #[test]
    fn every_example_is_accepted() {
        let mut others = Vec::new();
        for format in Format::all() {
            for (index, example) in format.examples().iter().enumerate() {
                let outcome = read(format, example);
                if outcome != Outcome::Accepted {
                    others.push((format.name(), index, outcome));
                }
            }
        }
        assert!(others.is_empty(), "{others:?}");
    }
}
