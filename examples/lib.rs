//! Examples of the Rust API, one topic per file in this folder.
