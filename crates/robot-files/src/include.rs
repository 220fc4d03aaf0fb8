//! Files that an MJCF file includes: `<include file="…"/>` is replaced by the children of the included root.

use std::path::{Path, PathBuf};

use crate::xml::line;
use crate::{RobotFileError, parse};

/// Maximum number of files in a chain of includes, and maximum size of all of them together [bytes].
const MAX_DEPTH: usize = 16;
const MAX_BYTES: usize = 16 << 20;

/// Returns the text with all included files. They are in `folder` or below it.
pub fn expand(text: &str, folder: Option<&Path>) -> Result<String, RobotFileError> {
    let mut left = MAX_BYTES;
    expand_within(text, folder, 0, &mut left)
}

fn expand_within(text: &str, folder: Option<&Path>, depth: usize, left: &mut usize) -> Result<String, RobotFileError> {
    let document = parse(text)?;
    let mut whole = String::with_capacity(text.len());
    let mut copied = 0;
    for include in document.descendants().filter(|node| node.has_tag_name("include")) {
        let file = include.attribute("file").unwrap_or_default();
        let error = |problem: String| RobotFileError::Include { line: line(include), file: file.to_owned(), problem };
        if depth >= MAX_DEPTH {
            return Err(error(format!("more than {MAX_DEPTH} files include each other")));
        }
        let path = within(folder, file).map_err(error)?;
        let inner = std::fs::read_to_string(&path).map_err(|cause| error(format!("it cannot be read: {cause}")))?;
        *left = left
            .checked_sub(inner.len())
            .ok_or_else(|| error(format!("all files have more than {MAX_BYTES} bytes")))?;
        // Paths of an included file are relative to the first file's folder, as in MuJoCo.
        let inner = expand_within(&inner, folder, depth + 1, left).map_err(|cause| error(cause.to_string()))?;
        whole.push_str(&text[copied..include.range().start]);
        whole.push_str(contents(&inner).map_err(error)?);
        copied = include.range().end;
        if whole.len() > MAX_BYTES {
            return Err(error(format!("all files together have more than {MAX_BYTES} bytes")));
        }
    }
    whole.push_str(&text[copied..]);
    Ok(whole)
}

/// Returns the path of an included file, which may not be outside the folder.
fn within(folder: Option<&Path>, file: &str) -> Result<PathBuf, String> {
    let folder = folder.ok_or("the folder of the robot file is not known")?;
    let absolute = |path: &Path| path.canonicalize().map_err(|cause| format!("{}: {cause}", path.display()));
    let (folder, path) = (absolute(folder)?, absolute(&folder.join(file))?);
    if path.starts_with(&folder) && path.is_file() {
        return Ok(path);
    }
    Err(format!("it is no file in {}", folder.display()))
}

/// Returns the text between the start and the end tag of the root.
fn contents(text: &str) -> Result<&str, String> {
    let document = parse(text).map_err(|error| error.to_string())?;
    let root = document.root_element();
    let (Some(first), Some(last)) = (root.first_child(), root.last_child()) else { return Ok("") };
    Ok(&text[first.range().start..last.range().end])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn include_is_replaced_by_what_its_root_contains() {
        let folder = std::env::temp_dir().join(format!("twinstep-include-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("parts")).expect("a folder");
        std::fs::write(
            folder.join("parts/leg.xml"),
            "<mujoco><body name=\"leg\"/><include file=\"foot.xml\"/></mujoco>",
        )
        .expect("written");
        std::fs::write(folder.join("foot.xml"), "<mujocoinclude><geom/></mujocoinclude>").expect("written");
        let text = "<mujoco><worldbody><include file=\"parts/leg.xml\"/></worldbody></mujoco>";
        let expected = "<mujoco><worldbody><body name=\"leg\"/><geom/></worldbody></mujoco>";
        assert_eq!(expand(text, Some(&folder)).as_deref(), Ok(expected));

        std::fs::write(folder.join("foot.xml"), text).expect("written");
        let error = expand(text, Some(&folder)).expect_err("endless").to_string();
        assert!(error.contains("include each other"), "{error}");
        for file in ["../../etc/passwd", "/etc/passwd", "none.xml", "parts"] {
            let error = expand(&text.replace("parts/leg.xml", file), Some(&folder)).expect_err(file).to_string();
            assert!(error.contains(file), "{error}");
        }
        assert!(expand(text, None).is_err());
        std::fs::remove_dir_all(folder).expect("removed");
    }
}
