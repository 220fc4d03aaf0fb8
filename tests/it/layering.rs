//! Allowed dependencies between the crates and between their modules, and the crates that may use each large library.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use twinstep_effects::CATALOGUE;

/// Crate folders and the workspace crates that each may use. Leaf crates use only the core; applications combine them.
const MAY_USE: [(&str, &[&str]); 33] = [
    // Core.
    ("crates/files", &[]),
    ("crates/simd", &[]),
    ("crates/model", &[]),
    ("crates/dynamics", &["simd", "model"]),
    ("crates/robot-files", &["model"]),
    ("crates/effects", &["model", "robot-files"]),
    ("crates/unitree", &["model"]),
    ("crates/logs", &["files", "model", "effects", "unitree"]),
    ("protocol", &["model"]),
    // Leaf crates.
    ("crates/sim", &["simd", "model", "dynamics", "robot-files"]),
    ("crates/envs", &["model", "effects"]),
    ("crates/identify", &["model", "dynamics", "effects", "logs"]),
    ("crates/diagnose", &["model", "effects", "logs", "identify", "inference"]),
    ("crates/policy", &["files", "simd", "model"]),
    ("crates/learning", &["model", "policy"]),
    ("crates/measures", &["model", "envs", "policy", "learning", "sim"]),
    ("crates/agent", &["model", "effects", "logs", "policy"]),
    ("crates/session", &[]),
    ("crates/viewer", &["model"]),
    ("crates/robot", &["model", "logs", "unitree"]),
    ("ensemble", &["files", "simd", "model", "effects", "logs"]),
    // Applications.
    ("env-server", &["model", "effects", "protocol", "session", "sim", "envs", "ensemble", "policy"]),
    ("clients/rust", &["model", "protocol", "session", "policy"]),
    ("crates/report", &["files", "model", "dynamics", "effects", "logs", "sim", "identify", "diagnose"]),
    ("crates/inference", &["model", "dynamics", "effects", "logs", "identify", "sim"]),
    ("crates/hunt", &["files", "model", "effects", "logs", "sim", "identify", "diagnose"]),
    ("crates/excite", &["model", "effects", "logs", "identify", "policy", "envs", "sim"]),
    (
        "crates/bench",
        &[
            "simd",
            "model",
            "robot-files",
            "effects",
            "logs",
            "protocol",
            "sim",
            "envs",
            "identify",
            "ensemble",
            "env-server",
            "client",
            "policy",
            "learning",
            "viewer",
        ],
    ),
    (
        "crates/workflows",
        &[
            "files",
            "model",
            "effects",
            "logs",
            "protocol",
            "sim",
            "envs",
            "identify",
            "inference",
            "diagnose",
            "ensemble",
            "env-server",
            "client",
            "policy",
            "learning",
            "measures",
            "agent",
            "report",
            "excite",
            "viewer",
        ],
    ),
    (
        "crates/cli",
        &[
            "files",
            "simd",
            "model",
            "robot-files",
            "effects",
            "logs",
            "protocol",
            "sim",
            "envs",
            "identify",
            "inference",
            "ensemble",
            "env-server",
            "client",
            "policy",
            "measures",
            "agent",
            "robot",
            "report",
            "excite",
            "hunt",
            "bench",
            "viewer",
            "workflows",
        ],
    ),
    ("examples", &["model", "robot-files", "sim", "env-server", "client"]),
    ("xtask", &["files"]),
    (
        "tests",
        &[
            "simd",
            "model",
            "robot-files",
            "dynamics",
            "effects",
            "logs",
            "protocol",
            "session",
            "sim",
            "envs",
            "identify",
            "inference",
            "diagnose",
            "policy",
            "learning",
            "agent",
            "ensemble",
            "env-server",
            "client",
            "unitree",
            "robot",
            "excite",
            "hunt",
            "report",
        ],
    ),
];

/// Libraries and the only crates that may use them.
const RESTRICTED_LIBRARIES: [(&str, &[&str]); 11] = [
    ("rapier3d", &["crates/sim"]),
    ("burn", &["ensemble", "tests"]),
    ("zenoh", &["crates/session", "env-server", "clients/rust", "tests"]),
    ("clap", &["crates/cli", "tests"]),
    ("plotters", &["crates/report"]),
    ("parquet", &["crates/logs"]),
    ("mcap", &["crates/logs", "crates/viewer", "tests"]),
    ("rustdds", &["crates/robot"]),
    ("ratatui", &["crates/cli"]),
    ("axum", &["crates/viewer"]),
    ("nalgebra", &["crates/identify", "crates/inference", "crates/excite"]),
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

/// Names of the shape of one robot: twelve joints, four legs.
const QUADRUPED: [&str; 7] = ["NUM_JOINTS", "NUM_LEGS", "PerJoint", "PerLeg", "JOINT_NAMES", "JointKind", "Leg::"];

/// Lines of code outside tests that may name the shape of the Go2, by crate. Every other crate serves any robot. `unitree` and `robot` are the
/// Go2's own; diagnosis, its bench and `excite` are still for quadrupeds.
const LINES_OF_QUADRUPEDS: [(&str, usize); 25] = [
    ("crates/model", 136),
    ("crates/dynamics", 21),
    ("crates/robot-files", 20),
    ("crates/effects", 34),
    ("crates/unitree", 4),
    ("crates/logs", 22),
    ("protocol", 5),
    ("crates/sim", 63),
    ("crates/envs", 36),
    ("crates/identify", 89),
    ("crates/diagnose", 25),
    ("crates/learning", 8),
    ("crates/measures", 2),
    ("crates/agent", 9),
    ("crates/viewer", 3),
    ("crates/robot", 111),
    ("ensemble", 50),
    ("env-server", 2),
    ("crates/report", 18),
    ("crates/inference", 7),
    ("crates/hunt", 27),
    ("crates/excite", 5),
    ("crates/bench", 21),
    ("crates/workflows", 6),
    ("crates/cli", 12),
];

#[test]
fn crates_name_the_shape_of_the_go2_no_more_often_than_before() {
    for (folder, _) in MAY_USE.into_iter().filter(|(folder, _)| *folder != "tests" && *folder != "examples") {
        let mut found = BTreeMap::new();
        modules(&root().join(folder).join("src"), &[], &mut found);
        let names = |line: &str| QUADRUPED.iter().any(|name| line.contains(name)) || line.contains("; 12]");
        let lines = found.values().flat_map(|code| code.lines()).filter(|line| names(line)).count();
        let allowed = LINES_OF_QUADRUPEDS.iter().find(|(name, _)| *name == folder).map_or(0, |(_, allowed)| *allowed);
        assert_eq!(
            lines, allowed,
            "{folder}: lines that name twelve joints or four legs; use the robot's own, or lower the number"
        );
    }
}

/// Lines of code outside tests that name an effect of the catalogue, by crate. An effect is one file: everything else reads its record.
/// `mujoco` says which effects it lacks, `randomise` and the bench change some of them, and a few have parts that no record describes.
const LINES_OF_EFFECTS: [(&str, usize); 6] = [
    ("crates/sim", 12),
    ("crates/envs", 7),
    ("crates/diagnose", 1),
    ("crates/robot", 2),
    ("crates/inference", 16),
    ("crates/hunt", 3),
];
/// Crates in which the names are attributes of robot files, or the catalogue itself.
const OTHER_NAMES: [&str; 5] = ["crates/effects", "crates/model", "crates/robot-files", "tests", "examples"];

#[test]
fn crates_name_effects_no_more_often_than_before() {
    for (folder, _) in MAY_USE.into_iter().filter(|(folder, _)| !OTHER_NAMES.contains(folder)) {
        let mut found = BTreeMap::new();
        modules(&root().join(folder).join("src"), &[], &mut found);
        let names = |line: &str| CATALOGUE.iter().any(|effect| line.contains(&format!("\"{}\"", effect.name)));
        let lines = found.values().flat_map(|code| code.lines()).filter(|line| names(line)).count();
        let allowed = LINES_OF_EFFECTS.iter().find(|(name, _)| *name == folder).map_or(0, |(_, allowed)| *allowed);
        assert_eq!(lines, allowed, "{folder}: lines that name an effect; read its record, or lower the number");
    }
}

/// Path of a module in its crate; empty for the root.
type Module = Vec<String>;

/// Appends the modules in `folder`, each with its code without comments and tests. `parent` is the module of `folder`.
fn modules(folder: &Path, parent: &[String], found: &mut BTreeMap<Module, String>) {
    let paths = std::fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path());
    for path in paths.filter(|path| path.file_stem().unwrap() != "tests") {
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let is_parent = ["lib", "main", "mod"].contains(&name.as_str());
        let module = if is_parent { parent.to_vec() } else { [parent, std::slice::from_ref(&name)].concat() };
        if path.is_dir() {
            modules(&path, &module, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = std::fs::read_to_string(&path).unwrap().replace("#[cfg(test)]\nmod tests;", "");
            let code = text.split("#[cfg(test)]").next().unwrap();
            let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
            found.insert(module, lines.flat_map(|line| [line, "\n"]).collect());
        }
    }
}

/// Reads the paths of `a::b` or `a::{b, c::d}` at the start of `text`. Returns them and the text behind them.
fn paths(text: &str) -> (Vec<Module>, &str) {
    let text = text.trim_start();
    if let Some(mut rest) = text.strip_prefix('{') {
        let mut all = Vec::new();
        loop {
            let (found, after) = paths(rest);
            // A comma may be the last character in the braces.
            all.extend(found.into_iter().filter(|path| !path[0].is_empty()));
            let end = after.find([',', '}']).unwrap();
            rest = &after[end + 1..];
            if after[end..].starts_with('}') {
                return (all, rest);
            }
        }
    }
    let end = text.find(|character: char| !character.is_alphanumeric() && character != '_').unwrap_or(text.len());
    let (name, rest) = (text[..end].to_owned(), &text[end..]);
    let Some(rest) = rest.strip_prefix("::") else { return (vec![vec![name]], rest) };
    let (found, rest) = paths(rest);
    (found.into_iter().map(|path| [vec![name.clone()], path].concat()).collect(), rest)
}

/// Returns the module that defines `path`, which may be an item that another module publishes with `pub use`.
fn defining_module(path: &[String], all: &BTreeMap<Module, String>) -> Module {
    let length = (0..=path.len()).rev().find(|length| all.contains_key(&path[..*length])).unwrap();
    let module = path[..length].to_vec();
    let published = all[&module].split("pub use ").skip(1).flat_map(|text| paths(text).0);
    let mut same_name = published.filter(|found| found.last() == path.get(length));
    let source = same_name.find_map(|found| {
        let full = [module.clone(), found].concat();
        all.contains_key(&full[..=length]).then_some(full)
    });
    source.map_or(module, |full| defining_module(&full, all))
}

/// Returns which modules each module imports, itself or in its children. An import connects two modules of one parent.
fn imports(all: &BTreeMap<Module, String>) -> BTreeMap<Module, BTreeSet<Module>> {
    let mut found = BTreeMap::<Module, BTreeSet<Module>>::new();
    for (module, code) in all {
        for (start, _) in code.match_indices("crate::").chain(code.match_indices("super::")) {
            for path in paths(&code[start..]).0.iter().filter(|_| !code[..start].ends_with("::")) {
                let ups = path.iter().take_while(|name| *name == "super").count();
                let base = if ups > 0 { &module[..module.len() - ups] } else { &[] };
                let imported = defining_module(&[base, &path[ups.max(1)..]].concat(), all);
                let common = module.iter().zip(&imported).take_while(|(own, other)| own == other).count();
                if common < module.len().min(imported.len()) {
                    found.entry(module[..=common].to_vec()).or_default().insert(imported[..=common].to_vec());
                }
            }
        }
    }
    found
}

#[test]
fn modules_of_a_crate_import_each_other_in_one_direction() {
    for (folder, _) in MAY_USE {
        let mut all = BTreeMap::new();
        modules(&root().join(folder).join("src"), &[], &mut all);
        let mut left = imports(&all);
        // A module that imports none of those left is not in a circle.
        while let Some((end, _)) = left.iter().find(|(_, to)| to.iter().all(|to| !left.contains_key(to))) {
            let end = end.clone();
            left.remove(&end);
        }
        // Every module left imports another one left, so a walk along the imports comes back to one of its modules.
        let mut walk: Vec<&Module> = left.keys().take(1).collect();
        while let Some((last, _)) = walk.split_last().filter(|(last, before)| !before.contains(last)) {
            walk.push(left[*last].iter().find(|to| left.contains_key(*to)).unwrap());
        }
        let first = walk.iter().position(|module| Some(module) == walk.last()).unwrap_or(0);
        let names: Vec<_> = walk[first..].iter().map(|module| module.join("::")).collect();
        assert!(names.is_empty(), "modules of {folder} import each other in a circle: {}", names.join(" -> "));
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

#[test]
fn lock_file_has_the_corrected_crates() {
    // Cargo ignores a patch with another version than the dependency, with a warning only.
    let lock: toml::Table = std::fs::read_to_string(root().join("Cargo.lock")).unwrap().parse().unwrap();
    let packages = lock["package"].as_array().unwrap();
    for name in ["zenoh-link-tls", "rustdds"] {
        let copies: Vec<_> = packages.iter().filter(|package| package["name"].as_str() == Some(name)).collect();
        assert_eq!(copies.len(), 1, "{copies:?}");
        assert!(copies[0].get("source").is_none(), "not from third_party: {:?}", copies[0]);
    }
}
