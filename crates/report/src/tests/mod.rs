//! Reports of constructed diagnoses on a real and on a simulated log.

#![allow(clippy::unwrap_used)]

mod browser;
mod samples;

use std::collections::BTreeMap;

use twinstep_diagnose::{Diagnosis, RmsErrors, Unexplained};
use twinstep_effects::ModelFile;
use twinstep_logs::Log;
use twinstep_model::BaseMount;

use crate::page::page;
use samples::{chirp, evidence, findings, loaded, recording, simulated, three_joints};

/// Tags without a closing tag.
const VOID: [&str; 2] = ["meta", "!doctype"];

/// Asserts that every opened tag is closed, in order.
fn assert_well_formed(page: &str) {
    let mut open = Vec::new();
    for tag in page.split('<').skip(1) {
        let (tag, text) = tag.split_once('>').expect("a tag ends");
        assert!(!text.contains('>'), "a lone > in {text}");
        let name = tag.split([' ', '\n', '/']).find(|word| !word.is_empty()).expect("a tag has a name");
        if tag.starts_with('/') {
            assert_eq!(open.pop(), Some(name));
        } else if !tag.ends_with('/') && !VOID.contains(&name) {
            open.push(name);
        }
    }
    assert!(open.is_empty(), "{open:?} stay open");
}

/// Asserts what holds for every page.
fn check(page: &str) {
    assert_well_formed(page);
    for fetched in ["http:", "https:", "<script", "javascript:", " src=", "@import", "url(", " href="] {
        assert!(!page.to_lowercase().contains(fetched), "{fetched}");
    }
    assert!(!page.contains("NaN") && !page.contains("inf "), "a number is not finite");
    assert!(page.len() < 1_000_000, "{} bytes", page.len());
}

fn nothing() -> Diagnosis {
    let errors = RmsErrors { torque_rmse_nm: None, q_rmse_rad: Some(0.002) };
    Diagnosis {
        baseline: errors,
        extended: errors,
        noise_floor: errors,
        findings: Vec::new(),
        joint_gains: BTreeMap::new(),
        also_fitted: Vec::new(),
        confusable: Vec::new(),
        unexplained: Unexplained::default(),
        learned_residual: None,
        next_experiment: None,
        decisions: Vec::new(),
        not_reported: Vec::new(),
        promise: None,
        extended_model: "extended.toml".to_owned(),
    }
}

#[test]
fn page_has_headline_twelve_joints_time_series_laws_and_provenance() {
    let (diagnosis, extended) = findings();
    let page = page(&diagnosis, &evidence(&recording(), &extended));
    check(&page);
    assert!(page.contains("<h1><strong>Coulomb friction of the calves</strong> (1.00 N·m, 95 %: 0.94 to 1.06), "));
    assert!(
        page.contains("by <strong>−61 %</strong>. The prediction")
            && page.contains("−58 % (90 % interval −63 % to −50 %)")
    );
    assert!(page.contains("together they remove 61 % of the joint position error (0.0360 → 0.0140 rad)"));
    assert_eq!(page.matches("class=\"cell\"").count(), 24, "twelve of each model");
    assert_eq!(page.matches("class=\"line measured\"").count(), 1);
    assert_eq!(page.matches("class=\"line law\"").count(), 3, "one per cause");
    assert!(page.contains("data/go2_air_chirp") && page.contains("3200 rows") && page.contains("twinstep diagnose"));
}

#[test]
fn friction_is_plotted_as_a_step_over_velocity_with_the_added_torque() {
    let (_, extended) = findings();
    let evidence = evidence(&recording(), &extended);
    let law = evidence.laws.iter().find(|law| law.cause.0 == "coulomb_friction").unwrap();
    assert_eq!(law.x_label, "joint velocity [rad/s]");
    for bin in law.bins.iter().filter(|bin| bin.x.abs() > 0.5) {
        assert!((bin.law - bin.x.signum()).abs() < 0.02, "{bin:?}");
    }
}

#[test]
fn inverse_dynamics_residual_of_a_simulated_robot_is_its_friction() {
    let (log, diagnosis, extended) = simulated();
    let evidence = evidence(&log, &extended);
    let law = &evidence.laws[0];
    assert_eq!(law.cause, ("viscous_friction".to_owned(), "FL_thigh".to_owned()));
    for bin in &law.bins {
        // Smoothing over three rows changes the derivative of noiseless rows.
        assert!((bin.mean - bin.law).abs() < 0.1, "{bin:?}");
        assert!((bin.law - 0.3 * bin.x).abs() < 1e-6, "{bin:?}");
    }
    assert_eq!(evidence.strips.len(), 2, "position and torque");
    check(&page(&diagnosis, &evidence));
}

#[test]
fn payload_of_a_standing_robot_is_plotted_over_time() {
    let (log, extended) = loaded();
    let evidence = evidence(&log, &extended);
    let law = &evidence.laws[0];
    assert_eq!([law.x_label, law.y_label], ["time [s]", "position error [rad]"]);
    assert!(law.bins.iter().map(|bin| bin.law).sum::<f64>() > 0.0, "the payload explains a part of the error");
    check(&page(&nothing(), &evidence));
}

#[test]
fn report_without_causes_states_no_model_error() {
    let page = page(&nothing(), &evidence(&chirp(&ModelFile::default(), BaseMount::Fixed), &ModelFile::default()));
    check(&page);
    assert!(page.contains("<h1>No model error above the noise.</h1>"));
    assert!(!page.contains("Identified causes") && page.contains("no two causes"));
}

#[test]
fn headline_states_what_the_residual_depends_on() {
    let unexplained = Unexplained {
        fraction: 0.8,
        depends_on: vec!["q_FR_hip".to_owned(), "dq_FR_hip".to_owned()],
        ..Unexplained::default()
    };
    let page = page(
        &Diagnosis { unexplained, ..nothing() },
        &evidence(&chirp(&ModelFile::default(), BaseMount::Fixed), &ModelFile::default()),
    );
    check(&page);
    assert!(page.contains("it depends on <code>q_FR_hip</code> and <code>dq_FR_hip</code>.</h1>"));
}

#[test]
fn log_with_three_joints_leaves_nine_cells_grey() {
    let log: Log = three_joints();
    let page = page(&nothing(), &evidence(&log, &findings().1));
    check(&page);
    assert_eq!(page.matches("class=\"cell\"").count(), 6);
    assert_eq!(page.matches("class=\"cell absent\"").count(), 18);
}

#[test]
fn text_from_files_is_never_markup() {
    const EVIL: &str = "\"'><img src=x onerror=alert(1)><script>alert(1)</script>&";
    let (mut diagnosis, extended) = findings();
    let text = || EVIL.to_owned();
    diagnosis.extended_model = text();
    diagnosis.unexplained =
        Unexplained { fraction: 0.5, depends_on: vec![text()], text: text(), ..Unexplained::default() };
    diagnosis.confusable[0].effects = [text(), format!("armature@{EVIL}")];
    diagnosis.confusable[0].experiment = text();
    let mut evidence = evidence(&recording(), &extended);
    evidence.provenance.command = text();
    evidence.provenance.date = text();
    evidence.provenance.model = text();
    evidence.provenance.logs[0].name = text();
    evidence.provenance.logs[0].segments = vec![text()];
    let estimate = diagnosis.findings[0].parameters["torque_nm"].clone();
    let finding = &mut diagnosis.findings[0];
    (finding.effect, finding.scope, finding.evidence) = (text(), text(), text());
    finding.parameters.insert(text(), estimate);
    finding.ambiguous_with = vec![text()];
    (finding.rivals[0].effect, finding.rivals[0].scope) = (text(), text());
    for findings in [diagnosis.findings.clone(), Vec::new()] {
        let page = page(&Diagnosis { findings, ..diagnosis.clone() }, &evidence);
        assert_well_formed(&page);
        assert!(!page.contains("<img") && !page.contains("<script") && page.contains("&lt;script&gt;"));
    }
}

#[test]
fn error_names_a_path_that_cannot_be_written() {
    let evidence = evidence(&chirp(&ModelFile::default(), BaseMount::Fixed), &ModelFile::default());
    let error = crate::write_report(&nothing(), &evidence, std::path::Path::new("/no/such/report.html"))
        .unwrap_err()
        .to_string();
    assert!(error.starts_with("cannot write the report `/no/such/report.html`: "), "{error}");
}

#[test]
fn gains_that_differ_from_joint_to_joint_are_in_a_section_of_their_own() {
    let data = evidence(&chirp(&ModelFile::default(), BaseMount::Fixed), &ModelFile::default());
    let gains = BTreeMap::from([("FL_calf".to_owned(), [0.962, 1.04]), ("RR_hip".to_owned(), [1.031, 0.97])]);
    let shown = page(&Diagnosis { joint_gains: gains, ..nothing() }, &data);
    check(&shown);
    assert!(
        shown.contains("are 0.962 to 1.03 times")
            && shown.contains(">FL_calf</th>")
            && shown.contains("<h1>No cause: the gains")
    );
    assert!(!page(&nothing(), &data).contains("Gains of the joints"));
}
