//! Bounds of a COLLADA file (*.dae).
//!
//! Geometries are placed by the nodes of the scene, in metres. The axis that points up is not applied, as in ROS: a link's frame
//! is that of its URDF (COLLADA 1.4.1, `visual_scene`, `node`, `mesh`).

use std::collections::BTreeMap;

use glam::{DMat4, DQuat, DVec3};
use roxmltree::{Document, Node};

/// Deepest nesting of nodes, and most vertices that are placed: a scene may have a geometry many times.
const MAX_DEPTH: usize = 32;
const MAX_VERTICES: usize = 4_000_000;

/// Lowest and highest coordinates of vertices [m].
type Bounds = [DVec3; 2];

/// Returns the bounds of the scene; of all geometries where they are defined if there is no scene. `None` without vertices.
pub fn bounds(text: &str) -> Option<Bounds> {
    let document = Document::parse(text).ok()?;
    let root = document.root_element();
    let unit = find(root, "unit").and_then(|unit| unit.attribute("meter")).and_then(|metres| metres.parse().ok());
    let unit = DMat4::from_scale(DVec3::splat(unit.unwrap_or(1.0)));
    let ids = root.descendants().filter_map(|node| Some((node.attribute("id")?, node))).collect();
    let mut scene = Scene { ids, left: MAX_VERTICES, bounds: None };
    match find(root, "visual_scene") {
        Some(node) => scene.place(node, unit, 0)?,
        None => {
            for geometry in root.descendants().filter(|node| node.has_tag_name("geometry")) {
                scene.add(geometry, unit)?;
            }
        }
    }
    scene.bounds
}

fn find<'a, 'i>(root: Node<'a, 'i>, name: &str) -> Option<Node<'a, 'i>> {
    root.descendants().find(|node| node.tag_name().name() == name)
}

struct Scene<'a, 'i> {
    ids: BTreeMap<&'a str, Node<'a, 'i>>,
    /// Number of vertices that may still be placed.
    left: usize,
    bounds: Option<Bounds>,
}

impl<'a, 'i> Scene<'a, 'i> {
    /// Adds the geometries of a node and of the nodes in it. `None` if one is missing, or if there are too many.
    fn place(&mut self, node: Node<'a, 'i>, parent: DMat4, depth: usize) -> Option<()> {
        (depth <= MAX_DEPTH).then_some(())?;
        let frame = parent * transform(node);
        for child in node.children().filter(Node::is_element) {
            match child.tag_name().name() {
                "node" => self.place(child, frame, depth + 1)?,
                "instance_geometry" => self.add(self.by_id(child.attribute("url")?)?, frame)?,
                _ => {}
            }
        }
        Some(())
    }

    /// Adds the positions of a geometry.
    fn add(&mut self, geometry: Node<'a, 'i>, frame: DMat4) -> Option<()> {
        let vertices = find(geometry, "vertices")?;
        let position = vertices.children().find(|input| input.attribute("semantic") == Some("POSITION"))?;
        let source = self.by_id(position.attribute("source")?)?;
        let values = numbers(find(source, "float_array")?);
        self.left = self.left.checked_sub(values.len() / 3)?;
        for point in values.chunks_exact(3).map(|point| frame.transform_point3(DVec3::from_slice(point))) {
            let [low, high] = self.bounds.unwrap_or([point; 2]);
            self.bounds = Some([low.min(point), high.max(point)]);
        }
        Some(())
    }

    /// Returns the element to which `#id` refers.
    fn by_id(&self, reference: &str) -> Option<Node<'a, 'i>> {
        self.ids.get(reference.strip_prefix('#')?).copied()
    }
}

/// Returns the transformation of a node: the product of its elements, in order.
fn transform(node: Node) -> DMat4 {
    let of_element = |element: Node| {
        let values = numbers(element);
        let vector = |values: &[f64]| DVec3::from_slice(values);
        match (element.tag_name().name(), values.len()) {
            // Row by row.
            ("matrix", 16) => DMat4::from_cols_slice(&values).transpose(),
            ("translate", 3) => DMat4::from_translation(vector(&values)),
            ("scale", 3) => DMat4::from_scale(vector(&values)),
            ("rotate", 4) => {
                let axis = vector(&values[..3]).normalize_or_zero();
                DMat4::from_quat(DQuat::from_scaled_axis(axis * values[3].to_radians()))
            }
            _ => DMat4::IDENTITY,
        }
    };
    node.children().filter(Node::is_element).map(of_element).fold(DMat4::IDENTITY, |product, part| product * part)
}

fn numbers(element: Node) -> Vec<f64> {
    element.text().unwrap_or_default().split_whitespace().map_while(|word| word.parse().ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vertices_are_placed_by_the_nodes_of_the_scene() {
        // A tetrahedron in millimetres, turned by 90° about z, then moved by 1000 along x.
        let text = r##"<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
            <asset><unit name="millimeter" meter="0.001"/><up_axis>Y_UP</up_axis></asset>
            <library_geometries><geometry id="body"><mesh>
                <source id="normals"><float_array id="n" count="3">9 9 9</float_array></source>
                <source id="positions"><float_array id="p" count="12">0 0 0  100 0 0  0 200 0  0 0 300</float_array></source>
                <vertices id="v"><input semantic="POSITION" source="#positions"/></vertices>
            </mesh></geometry></library_geometries>
            <library_visual_scenes><visual_scene id="s"><node><translate>1000 0 0</translate>
                <node><rotate>0 0 1 90</rotate><instance_geometry url="#body"/></node></node></visual_scene></library_visual_scenes>
            </COLLADA>"##;
        let close = |found: Option<Bounds>, expected: [[f64; 3]; 2]| {
            let found = found.expect("a scene");
            found.iter().zip(expected).all(|(one, other)| one.distance(DVec3::from_array(other)) < 1e-12)
        };
        assert!(close(bounds(text), [[0.8, 0.0, 0.0], [1.0, 0.1, 0.3]]));
        let without_scene = format!("{}</COLLADA>", &text[..text.find("<library_visual").expect("a scene")]);
        assert!(close(bounds(&without_scene), [[0.0; 3], [0.1, 0.2, 0.3]]));
        assert_eq!(bounds("<COLLADA>"), None);
        assert_eq!(bounds(&text.replace("#body", "#other")), None, "a geometry that is not there");
    }

    #[test]
    fn geometry_that_is_placed_too_often_has_no_bounds() {
        let point = "0 0 0 ".repeat(1000);
        let geometry = format!(
            r##"<geometry id="g"><mesh><source id="p"><float_array>{point}</float_array></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices></mesh></geometry>"##
        );
        let instances = r##"<instance_geometry url="#g"/>"##.repeat(MAX_VERTICES / 1000 + 1);
        let text = format!("<COLLADA>{geometry}<visual_scene>{instances}</visual_scene></COLLADA>");
        assert_eq!(bounds(&text), None);
    }
}
