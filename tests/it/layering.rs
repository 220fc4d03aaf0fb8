//! Allowed dependencies between the crates, and the crates that may use each large library.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Crate folders and the workspace crates that each may use. Leaf crates use only the core; applications combine them.
const MAY_USE: [(&str, &[&str]); 19] = [
    // Core.
    ("crates/simd", &[]),
    ("crates/model", &["simd"]),
    ("crates/effects", &["model"]),
    ("crates/logs", &["model", "effects"]),
    ("protocol", &["model"]),
    // Leaf crates.
    ("crates/sim", &["simd", "model"]),
    ("crates/envs", &["model", "effects"]),
    ("crates/identify", &["model", "effects", "logs"]),
    ("crates/diagnose", &["model", "effects", "logs", "identify"]),
    ("crates/session", &[]),
    ("ensemble", &["simd", "model", "effects", "logs"]),
    // Applications.
    ("env-server", &["model", "effects", "protocol", "session", "sim", "envs", "ensemble"]),
    ("clients/rust", &["model", "protocol", "session"]),
    ("crates/report", &["model", "effects", "logs", "sim", "identify", "diagnose"]),
    ("crates/hunt", &["model", "effects", "logs", "sim", "identify", "diagnose"]),
    (
        "crates/bench",
        &[
            "simd",
            "model",
            "effects",
            "logs",
            "protocol",
            "sim",
            "envs",
            "identify",
            "ensemble",
            "env-server",
            "client",
        ],
    ),
    (
        "crates/cli",
        &[
            "model",
            "effects",
            "logs",
            "protocol",
            "sim",
            "envs",
            "identify",
            "diagnose",
            "ensemble",
            "env-server",
            "client",
            "report",
            "hunt",
            "bench",
        ],
    ),
    ("examples", &["model", "env-server", "client"]),
    (
        "tests",
        &[
            "simd",
            "model",
            "effects",
            "logs",
            "protocol",
            "session",
            "sim",
            "envs",
            "identify",
            "diagnose",
            "ensemble",
            "env-server",
            "client",
        ],
    ),
];

/// Libraries and the only crates that may use them.
const RESTRICTED_LIBRARIES: [(&str, &[&str]); 8] = [
    ("rapier3d", &["crates/sim"]),
    ("burn", &["ensemble"]),
    ("zenoh", &["crates/session", "env-server", "clients/rust", "tests"]),
    ("clap", &["crates/cli", "tests"]),
    ("plotters", &["crates/report"]),
    ("parquet", &["crates/logs"]),
    ("mcap", &["crates/logs"]),
    ("nalgebra", &["crates/identify", "crates/diagnose"]),
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// Returns the names of all dependencies in the manifest of `folder`, including those for tests and builds.
fn dependencies(folder: &str) -> BTreeSet<String> {
    let text = std::fs::read_to_string(root().join(folder).join("Cargo.toml")).unwrap();
    let manifest: toml::Table = text.parse().unwrap();
    ["dependencies", "dev-dependencies", "build-dependencies"]
        .iter()
        .filter_map(|kind| manifest.get(*kind)?.as_table())
        .flat_map(|table| table.keys().cloned())
        .collect()
}

#[test]
fn every_workspace_member_has_a_list_of_allowed_dependencies() {
    let text = std::fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let manifest: toml::Table = text.parse().unwrap();
    let members: BTreeSet<&str> =
        manifest["workspace"]["members"].as_array().unwrap().iter().filter_map(toml::Value::as_str).collect();
    assert_eq!(members, MAY_USE.iter().map(|(folder, _)| *folder).collect());
}

#[test]
fn crates_use_only_allowed_crates() {
    for (folder, allowed) in MAY_USE {
        for name in dependencies(folder) {
            if let Some(used) = name.strip_prefix("twinstep-") {
                assert!(allowed.contains(&used), "{folder}/Cargo.toml uses {name}; it may use {allowed:?}");
            }
        }
    }
}

#[test]
fn large_libraries_are_used_only_by_their_crates() {
    for (folder, _) in MAY_USE {
        let used = dependencies(folder);
        for (library, allowed) in RESTRICTED_LIBRARIES {
            assert!(
                !used.contains(library) || allowed.contains(&folder),
                "{folder} uses {library}; only {allowed:?} may"
            );
        }
    }
}

/// Returns every crate that `arguments` select, with the features it is built with.
fn features(arguments: &[&str]) -> BTreeMap<String, BTreeSet<String>> {
    let tree = Command::new(env!("CARGO"))
        .args(["tree", "--offline", "--prefix", "none", "--no-dedupe", "--format", "{p}\t{f}"])
        .args(arguments)
        .current_dir(root())
        .output()
        .unwrap();
    assert!(tree.status.success(), "{}", String::from_utf8_lossy(&tree.stderr));
    let mut found = BTreeMap::<String, BTreeSet<String>>::new();
    for (package, features) in String::from_utf8(tree.stdout).unwrap().lines().filter_map(|line| line.split_once('\t'))
    {
        found.entry(package.to_owned()).or_default().extend(features.split(',').map(str::to_owned));
    }
    found
}

#[test]
fn program_and_tests_share_one_build_of_every_dependency() {
    let everything = features(&["--workspace", "--edges", "normal,build,dev"]);
    for (package, features) in features(&["--package", "twinstep-cli", "--edges", "normal,build"]) {
        let more: Vec<_> = everything[&package].difference(&features).collect();
        assert!(more.is_empty(), "the tests build {package} a second time, with {more:?}: add these features in `cli`");
    }
}
