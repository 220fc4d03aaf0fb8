//! Meshes that the section `<asset>` names.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use roxmltree::Node;

use crate::RobotFileError;
use crate::mesh::MeshFolder;
use crate::xml::{optional, vector};

/// File and scale of each mesh, by name.
pub struct Meshes<'a> {
    folder: MeshFolder,
    files: BTreeMap<&'a str, (&'a str, DVec3)>,
}

impl<'a> Meshes<'a> {
    /// Reads the names. `folder` is that of the robot file; `meshdir` is below it.
    pub fn read(root: Node<'a, 'a>, folder: Option<&Path>) -> Result<Self, RobotFileError> {
        let compiler =
            |name| root.children().filter(|node| node.has_tag_name("compiler")).find_map(|n| n.attribute(name));
        let inner = compiler("meshdir").or_else(|| compiler("assetdir")).unwrap_or_default();
        let folder = folder.map(|folder| folder.join(Path::new(inner).file_name().unwrap_or_default()));
        let folder = MeshFolder::new(folder.as_deref());
        let mut files = BTreeMap::new();
        let assets = root.children().filter(|node| node.has_tag_name("asset")).flat_map(|node| node.children());
        for node in assets.filter(|node| node.has_tag_name("mesh")) {
            // A mesh that is moved or made of numbers has other bounds than its file.
            let is_plain = node.attributes().all(|a| ["name", "class", "file", "scale"].contains(&a.name()));
            let Some(file) = node.attribute("file").filter(|_| is_plain) else { continue };
            let stem = Path::new(file).file_stem().and_then(|stem| stem.to_str()).unwrap_or(file);
            let scale = optional(node, "scale", "three numbers")?.map_or(DVec3::ONE, vector);
            files.insert(node.attribute("name").unwrap_or(stem), (file, scale));
        }
        Ok(Self { folder, files })
    }

    /// Returns the lowest and the highest coordinates of a mesh [m], if it can be read.
    pub fn bounds(&self, name: &str) -> Option<[DVec3; 2]> {
        let (file, scale) = self.files.get(name)?;
        self.folder.bounds(file, *scale)
    }
}
