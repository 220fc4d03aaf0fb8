//! The robots that the program contains: `--model g1` needs no file.

use std::borrow::Cow;
use std::io;
use std::path::{Path, PathBuf};

/// Folder of the files in the program. It is not one of the system.
const FOLDER: &str = "/twinstep/robots";

macro_rules! files {
    ($($name:literal),* $(,)?) => {
        [("go2.toml", "robot = \"go2\"\n"), $(($name, include_str!(concat!("../../../data/robots/", $name)))),*]
    };
}

/// Names and texts of the files: each robot has a model file.
const FILES: [(&str, &str); 19] = files![
    "a1.toml",
    "a1.xml",
    "aliengo.toml",
    "aliengo.xml",
    "anymal_c.toml",
    "anymal_c.xml",
    "b2.toml",
    "b2.urdf",
    "g1.toml",
    "g1.xml",
    "go1.toml",
    "go1.urdf",
    "mini_cheetah.toml",
    "mini_cheetah.xml",
    "so101.toml",
    "so101.xml",
    "spot.toml",
    "spot.xml",
];

/// Returns the names of the robots.
pub fn shipped_robots() -> impl Iterator<Item = &'static str> {
    FILES.iter().filter_map(|(name, _)| name.strip_suffix(".toml"))
}

/// Returns the path of a model file: for the name of a robot that of the file in the program, unless there is a file of this name.
pub(crate) fn resolved(path: &Path) -> Cow<'_, Path> {
    let known = path.to_str().and_then(|name| shipped_robots().find(|known| *known == name));
    match known {
        Some(name) if !path.is_file() => Cow::Owned(PathBuf::from(FOLDER).join(format!("{name}.toml"))),
        _ => Cow::Borrowed(path),
    }
}

/// Reads a file of the system or of the program.
pub(crate) fn read_to_string(path: &Path) -> io::Result<String> {
    let in_program = path.strip_prefix(FOLDER).ok().and_then(Path::to_str);
    match in_program.and_then(|name| FILES.iter().find(|(known, _)| *known == name)) {
        Some((_, text)) => Ok((*text).to_owned()),
        None => std::fs::read_to_string(path),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ModelFile, TreeModelFile};

    #[test]
    fn every_shipped_robot_is_loaded_by_its_name() {
        assert_eq!(shipped_robots().count(), 10);
        for name in shipped_robots() {
            let file = TreeModelFile::load(name).unwrap_or_else(|error| panic!("{name}: {error}"));
            assert!(file.nominal.joints.len() >= 6, "{name}");
        }
        let spot = ModelFile::load("spot").expect("a quadruped");
        assert!(spot.nominal.robot.contains("spot.xml"), "{}", spot.nominal.robot);
        let error = ModelFile::load("atlas").expect_err("not shipped").to_string();
        assert!(error.contains("atlas") && error.contains("mini_cheetah"), "{error}");
    }

    #[test]
    fn folder_of_the_program_has_all_robots_of_the_repository() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data/robots");
        for entry in std::fs::read_dir(folder).expect("the robots").flatten() {
            let name = entry.file_name().into_string().expect("a name");
            assert!(FILES.iter().any(|(known, _)| *known == name), "{name}");
        }
    }
}
