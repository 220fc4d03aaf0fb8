//! The report of a diagnosis: one page that needs nothing else, neither network nor script.

pub mod evidence;
mod findings;
mod html;
mod law;
mod overview;
mod plot;
mod remainder;
mod strip;
#[cfg(test)]
mod tests;
mod words;

use std::path::{Path, PathBuf};

use twinstep_sysid::Diagnosis;

use evidence::ReportData;

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
fn page(diagnosis: &Diagnosis, evidence: &ReportData) -> String {
    let log = evidence.provenance.logs.first().map_or("", |log| log.name.as_str());
    let sections = [
        overview::headline(diagnosis, evidence),
        overview::numbers(diagnosis),
        overview::heat_maps(evidence),
        overview::strips(evidence),
        findings::cards(diagnosis, evidence),
        findings::ranking(diagnosis),
        remainder::confusions(diagnosis),
        remainder::unexplained(diagnosis),
        remainder::provenance(diagnosis, &evidence.provenance),
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
