//! The report of a diagnosis: one HTML page without scripts that fetches nothing.

use std::path::{Path, PathBuf};

use twinstep_diagnose::Diagnosis;

use crate::report_data::ReportData;
use crate::{findings, html, limitations, overview};

const STYLE: &str = include_str!("style.css");

/// The page could not be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write the report `{path}`: {cause}", path = path.display())]
pub struct ReportError {
    path: PathBuf,
    cause: std::io::Error,
}

/// Writes the report of a diagnosis.
pub fn write(diagnosis: &Diagnosis, evidence: &ReportData, path: &Path) -> Result<(), ReportError> {
    std::fs::write(path, page(diagnosis, evidence)).map_err(|cause| ReportError { path: path.to_owned(), cause })
}

/// The page. Everything in it that comes from a file went through [`html::escape`]; the policy in its head keeps a
/// browser from running or fetching anything all the same.
pub(crate) fn page(diagnosis: &Diagnosis, evidence: &ReportData) -> String {
    let log = evidence.provenance.logs.first().map_or("", |log| log.name.as_str());
    let sections = [
        overview::headline(diagnosis, evidence),
        overview::numbers(diagnosis),
        overview::heat_maps(evidence),
        overview::strips(evidence),
        findings::cards(diagnosis, evidence),
        findings::ranking(diagnosis),
        limitations::confusions(diagnosis),
        limitations::unexplained(diagnosis),
        limitations::provenance(diagnosis, &evidence.provenance),
    ];
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <title>Diagnosis of {}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n{}</main>\n\
         </body>\n</html>\n",
        html::escape(log),
        sections.concat()
    )
}
