//! HTML report of a diagnosis, and all plots as SVG.
//!
//! - [`write_report`]: the HTML page of a diagnosis, from [`ReportData`].
//! - [`chart`]: panels with axes and lines, in one style.
//! - [`joint_plot`], [`evaluation_plot`], [`effect_plot`]: the plots of `demo`, `evaluate` and `effects`.
//! - [`effect_page`]: the page of an effect.
//! - [`joint_table()`]: the position error of each joint as text.

pub mod chart;
pub mod effect_page;
pub mod effect_plot;
pub mod evaluation_plot;
mod film_strip;
mod findings;
mod html;
pub mod joint_plot;
mod joint_table;
mod limitations;
mod model_evaluation;
mod overview;
mod page;
mod plot;
pub mod report_data;
mod residual_plot;
#[cfg(test)]
mod tests;
mod text;
mod time_series;
mod timeline;

pub use film_strip::film_strip;
pub use joint_table::joint_table;
pub use page::{ReportError, write as write_report};
pub use report_data::ReportData;
