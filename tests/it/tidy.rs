//! Checks of the repository itself: unfinished code, file headers, documented commands, vocabulary, links, file sizes,
//! programs that tests start.

use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// Appends every file below `folder` with one of `extensions` to `found`, without build outputs.
fn files(folder: &Path, extensions: &[&str], found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
        let (path, name) = (entry.path(), entry.file_name());
        if path.is_dir() {
            if !["target", ".git", ".venv", "node_modules", "twinstep-demo", "third_party"]
                .contains(&name.to_str().unwrap())
            {
                files(&path, extensions, found);
            }
        } else if path.extension().is_some_and(|extension| extensions.contains(&extension.to_str().unwrap())) {
            found.push(path);
        }
    }
}

fn sources(extensions: &[&str]) -> Vec<(PathBuf, String)> {
    let mut found = Vec::new();
    files(&root(), extensions, &mut found);
    assert!(found.len() > 2, "the search found no files");
    found.into_iter().map(|path| (path.clone(), std::fs::read_to_string(&path).unwrap())).collect()
}

#[test]
fn code_has_no_markers_of_unfinished_work() {
    // Assembled at run time, so that this file has no match.
    let marks =
        [["TO", "DO"].concat(), ["FIX", "ME"].concat(), ["todo", "!("].concat(), ["unimplemented", "!("].concat()];
    for (path, text) in sources(&["rs", "py", "toml", "md"]) {
        for (line, content) in text.lines().enumerate() {
            assert!(!marks.iter().any(|mark| content.contains(mark)), "{}:{}: {content}", path.display(), line + 1);
        }
    }
}

#[test]
fn results_are_written_by_the_one_function_that_writes_them_whole() {
    let home = root().join("crates/files");
    for (path, text) in sources(&["rs"]) {
        let is_test = path.components().any(|part| ["tests", "examples"].contains(&part.as_os_str().to_str().unwrap()));
        if path.starts_with(&home) || is_test || path.ends_with("tests.rs") {
            continue;
        }
        let code = text.split("#[cfg(test)]").next().unwrap();
        for (line, content) in code.lines().enumerate() {
            let is_own = content.contains("fs::write(") || content.contains("fs::rename(");
            assert!(!is_own, "{}:{}: use `twinstep_files`: {content}", path.display(), line + 1);
        }
    }
}

#[test]
fn every_rust_file_begins_with_a_module_comment() {
    for (path, text) in sources(&["rs"]) {
        assert!(text.starts_with("//! "), "{} starts without `//!`", path.display());
    }
}

#[test]
fn readme_has_the_two_commands_and_ci_runs_the_same_test_command() {
    let read = |path: &str| std::fs::read_to_string(root().join(path)).unwrap();
    let (readme, ci) = (read("README.md"), read(".ci/run"));
    assert!(readme.contains("cargo run --release -- demo"));
    assert!(readme.contains("cargo test --release --workspace") && ci.contains("cargo test --release --workspace"));
}

/// Replaced words, each with the standard term to use instead.
const REPLACED_WORDS: [(&str, &str); 32] = [
    ("learned drive", "actuator network"),
    ("learned drives", "actuator networks"),
    ("drive period", "actuator period"),
    ("drive periods", "actuator periods"),
    ("drive_hz", "actuator_hz"),
    ("drive_dt", "actuator_dt"),
    ("JointDrive", "ActuatorParams"),
    ("LearnedDrive", "ActuatorNetworkConfig"),
    ("held trunk", "fixed base"),
    ("free trunk", "floating base"),
    ("put down anew", "reset"),
    ("placed anew", "reset"),
    ("farewell", "shutdown grace period"),
    ("obituary", "exit report"),
    ("crews", "robots_by_member"),
    ("leftover", "residual power"),
    ("leftovers", "residual powers"),
    ("seats", "joint slots"),
    ("rivalry", "hypothesis pair"),
    ("untold", "not identifiable"),
    ("by heart", "trained for one value"),
    ("knows what it does not know", "estimates its epistemic uncertainty"),
    ("earns its name", "reaches the threshold"),
    ("gravity_in_base", "projected_gravity"),
    ("tracking_width", "tracking_sigma"),
    ("TauSensor", "TorqueSensor"),
    ("MemberDraw", "MemberSampling"),
    ("NoAnswerError", "RequestTimeoutError"),
    ("NoUniqueRobotError", "AmbiguousRobotError"),
    ("ServerDiedError", "ServerExitedError"),
    ("RefusedError", "RequestRejectedError"),
    ("sysid", "identify"),
];

/// Returns true if `text` contains `word` as a whole word.
fn has_word(text: &str, word: &str) -> bool {
    let is_name = |character: Option<char>| character.is_some_and(|c| c.is_alphanumeric() || c == '_');
    text.match_indices(word).any(|(start, _)| {
        !is_name(text[..start].chars().next_back()) && !is_name(text[start + word.len()..].chars().next())
    })
}

#[test]
fn every_file_of_the_catalogue_is_in_the_catalogue() {
    let mut found = Vec::new();
    files(&root().join("crates/effects/src/catalogue"), &["rs"], &mut found);
    for path in found.iter().filter(|path| !path.ends_with("mod.rs")) {
        let name = path.file_stem().unwrap().to_str().unwrap();
        assert!(twinstep_effects::Effect::named(name).is_some(), "{} is not in `CATALOGUE`", path.display());
    }
}

#[test]
fn sources_and_documents_do_not_use_replaced_words() {
    for (path, text) in sources(&["rs", "py", "md"]) {
        // The changelog lists the renamed identifiers, and this file lists the words.
        if path.ends_with("CHANGELOG.md") || path.ends_with("tests/it/tidy.rs") {
            continue;
        }
        for (word, term) in REPLACED_WORDS {
            assert!(!has_word(&text, word), "{}: \"{word}\" is not the field's term; write \"{term}\"", path.display());
        }
    }
}

#[test]
fn relative_links_in_documents_have_existing_targets() {
    for (path, text) in sources(&["md"]) {
        for target in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let file = target.split('#').next().unwrap();
            if file.is_empty() || file.contains("://") {
                continue;
            }
            assert!(path.parent().unwrap().join(file).exists(), "{} links to {target}", path.display());
        }
    }
}

#[test]
fn tests_build_the_program_before_they_start_it() {
    // Cargo does not build programs of other crates for tests. A target folder that was used before hides that.
    let path_without_build = ["with_file_name(", "\"twinstep\")"].concat();
    for (path, text) in sources(&["rs"]).into_iter().filter(|(path, _)| path.starts_with(root().join("tests/it"))) {
        assert!(!text.contains(&path_without_build), "{}: use `Programs::beside`", path.display());
    }
}

#[test]
fn examples_have_at_most_60_lines() {
    let mut found = Vec::new();
    files(&root().join("examples"), &["rs"], &mut found);
    for path in found {
        let lines = std::fs::read_to_string(&path).unwrap().lines().count();
        assert!(lines <= 60, "{} has {lines} lines", path.display());
    }
}
