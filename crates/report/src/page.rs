//! HTML report of a diagnosis: one page without scripts and without external resources.

use std::path::{Path, PathBuf};

use twinstep_diagnose::Diagnosis;

use crate::report_data::ReportData;
use crate::{findings, html, limitations, overview};

const STYLE: &str = include_str!("style.css");

/// The report could not be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write the report `{path}`: {cause}", path = path.display())]
pub struct ReportError {
    path: PathBuf,
    cause: std::io::Error,
}

/// Writes the report of a diagnosis.
pub fn write(diagnosis: &Diagnosis, data: &ReportData, path: &Path) -> Result<(), ReportError> {
    twinstep_files::write(path, page(diagnosis, data)).map_err(|cause| ReportError { path: path.to_owned(), cause })
}

/// Returns the page.
///
/// All text from files is escaped by [`html::escape`]. In addition, the policy in the page's head forbids the browser
/// to run or fetch anything.
pub(crate) fn page(diagnosis: &Diagnosis, data: &ReportData) -> String {
    let log = data.provenance.logs.first().map_or("", |log| log.name.as_str());
    let sections = [
        overview::headline(diagnosis, data),
        overview::numbers(diagnosis),
        overview::heat_maps(data),
        overview::strips(data),
        findings::cards(diagnosis, data),
        findings::ranking(diagnosis),
        limitations::confusions(diagnosis),
        limitations::joint_gains(diagnosis),
        limitations::unexplained(diagnosis),
        limitations::learned_residual(diagnosis),
        limitations::provenance(diagnosis, &data.provenance),
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
