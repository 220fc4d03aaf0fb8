//! Bounds of meshes that lie beside a robot file. Other formats than STL, OBJ and COLLADA are not read.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::collada;

/// Maximum size of all mesh files of a robot [bytes].
const MAX_BYTES: u64 = 256 << 20;
/// Folders in which a mesh is looked for, from the folder of the robot file.
const FOLDERS: [&str; 3] = ["", "meshes", "../meshes"];
/// Sizes of the header of a binary STL file with its number of triangles, and of a triangle [bytes].
const STL_HEADER: usize = 84;
const STL_TRIANGLE: usize = 50;

/// Lowest and highest coordinates of vertices [m].
type Bounds = [DVec3; 2];

/// The meshes of a robot. Each file is read once.
pub struct MeshFolder {
    folder: Option<PathBuf>,
    known: RefCell<BTreeMap<PathBuf, Option<Bounds>>>,
    /// Size that may still be read [bytes].
    left: Cell<u64>,
}

impl MeshFolder {
    /// Creates the meshes beside a robot file in `folder`.
    pub fn new(folder: Option<&Path>) -> Self {
        let folder = folder.map(Path::to_owned);
        Self { folder, known: RefCell::new(BTreeMap::new()), left: Cell::new(MAX_BYTES) }
    }

    /// Returns the lowest and the highest coordinates of a mesh [m]. `None` if it is not found, or of another format.
    ///
    /// Only the name of the file counts, and a folder beside the robot file: where a package is installed is not known.
    pub fn bounds(&self, file: &str, scale: DVec3) -> Option<Bounds> {
        let path = find(self.folder.as_deref()?, file)?;
        let known = self.known.borrow().get(&path).copied();
        let bounds = known.unwrap_or_else(|| self.read(&path));
        self.known.borrow_mut().insert(path, bounds);
        bounds.map(|corners| corners.map(|corner| scale * corner)).map(|[one, other]| [one.min(other), one.max(other)])
    }

    fn read(&self, path: &Path) -> Option<Bounds> {
        let size = path.metadata().ok()?.len();
        self.left.set(self.left.get().checked_sub(size)?);
        let bytes = std::fs::read(path).ok()?;
        let end = path.extension()?.to_str()?.to_ascii_lowercase();
        let vertices = match end.as_str() {
            "stl" => stl(&bytes),
            "obj" => words(std::str::from_utf8(&bytes).ok()?, "v"),
            "dae" => return collada::bounds(std::str::from_utf8(&bytes).ok()?).filter(is_finite),
            _ => return None,
        };
        let mut vertices = vertices.into_iter();
        let first = vertices.next()?;
        let [low, high] = vertices.fold([first; 2], |[low, high], vertex| [low.min(vertex), high.max(vertex)]);
        Some([low, high]).filter(is_finite)
    }
}

fn is_finite(bounds: &Bounds) -> bool {
    bounds.iter().all(|corner| corner.is_finite())
}

fn find(folder: &Path, file: &str) -> Option<PathBuf> {
    let name = Path::new(file).file_name()?;
    FOLDERS.iter().map(|inner| folder.join(inner).join(name)).find(|path| path.is_file())
}

/// Returns the vertices of an STL file, binary or text.
fn stl(bytes: &[u8]) -> Vec<DVec3> {
    let count =
        bytes.get(80..STL_HEADER).and_then(|count| count.try_into().ok()).map_or(0, u32::from_le_bytes) as usize;
    if count.checked_mul(STL_TRIANGLE).and_then(|size| size.checked_add(STL_HEADER)) != Some(bytes.len()) {
        return std::str::from_utf8(bytes).map(|text| words(text, "vertex")).unwrap_or_default();
    }
    let number = |at: &[u8]| f64::from(f32::from_le_bytes([at[0], at[1], at[2], at[3]]));
    let triangles = bytes[STL_HEADER..].chunks_exact(STL_TRIANGLE);
    // The normal, then three vertices.
    let corners = triangles.flat_map(|triangle| triangle[12..48].chunks_exact(12));
    corners.map(|corner| DVec3::new(number(corner), number(&corner[4..]), number(&corner[8..]))).collect()
}

/// Returns the vectors of the lines that begin with a word.
fn words(text: &str, first: &str) -> Vec<DVec3> {
    let vector = |line: &str| {
        let mut words = line.split_whitespace();
        (words.next()? == first).then_some(())?;
        let mut number = || words.next()?.parse::<f64>().ok();
        Some(DVec3::new(number()?, number()?, number()?))
    };
    text.lines().filter_map(vector).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_those_of_the_vertices_in_each_format() {
        let folder = tempfile::tempdir().expect("a folder");
        let robot = folder.path().join("urdf");
        std::fs::create_dir_all(folder.path().join("meshes")).expect("a folder");
        std::fs::create_dir_all(&robot).expect("a folder");
        let vertices = [[-1.0_f32, 0.0, 0.5], [2.0, 3.0, 0.0], [0.0, -1.0, 0.25]];
        let mut binary = vec![0; 80];
        binary.extend(1_u32.to_le_bytes());
        binary.extend([0; 12]);
        vertices.iter().flatten().for_each(|value| binary.extend(value.to_le_bytes()));
        binary.extend([0; 2]);
        let lines = |word: &str| {
            let line = |[x, y, z]: &[f32; 3]| format!("  {word} {x} {y} {z}");
            vertices.iter().map(line).collect::<Vec<_>>().join("\n")
        };
        std::fs::write(folder.path().join("meshes/b.STL"), binary).expect("written");
        std::fs::write(robot.join("t.stl"), format!("solid t\n{}\nendsolid", lines("vertex"))).expect("written");
        std::fs::write(robot.join("o.obj"), format!("# a mesh\n{}\nf 1 2 3\n", lines("v"))).expect("written");
        let expected = Some([DVec3::new(-2.0, -2.0, 0.0), DVec3::new(4.0, 6.0, 1.0)]);
        for file in ["package://robot/meshes/b.STL", "t.stl", "/elsewhere/o.obj"] {
            assert_eq!(MeshFolder::new(Some(&robot)).bounds(file, DVec3::splat(2.0)), expected, "{file}");
        }
        for (folder, file) in [(Some(&*robot), "none.stl"), (Some(&*robot), "o.dae"), (None, "t.stl")] {
            assert_eq!(MeshFolder::new(folder).bounds(file, DVec3::ONE), None, "{file}");
        }
    }
}
