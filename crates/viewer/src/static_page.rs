//! A page with its motion inside: one file that needs no program and no network.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;

use crate::frame::{Frame, SceneInfo};
use crate::web_server::{INDEX, MODULES, STYLE, VIEW_SCRIPT};

/// Returns a page (HTML) that plays `frames` of `scene`, with pause, speed and a slider for the time.
///
/// It has some 0.9 MB and 1.3 times the bytes of the frames.
pub fn static_page(scene: &SceneInfo, frames: &[Frame]) -> String {
    let bytes: Vec<u8> = frames.iter().flat_map(Frame::to_bytes).collect();
    let scene = SceneInfo { is_interactive: true, is_learning: false, velocity_bounds: None, ..scene.clone() };
    // Numbers and names are always JSON. In a script `<` could begin the tag that ends it.
    let scene = serde_json::to_string(&scene).unwrap_or_default().replace('<', "\\u003c");
    let program = format!(
        r#"<script>globalThis.recordedScene = {scene}; globalThis.recordedFrames = "{}";</script>
<script type="module">{VIEW_SCRIPT}</script>"#,
        BASE64.encode(bytes),
    );
    let page = INDEX
        .replace("<link rel=\"modulepreload\" href=\"three.min.js\">\n", "")
        .replace(r#"<link rel="stylesheet" href="view.css">"#, &format!("<style>{STYLE}</style>"));
    let page = MODULES.iter().fold(page, |page, (name, text)| {
        let inside = format!("\"data:text/javascript;base64,{}\"", BASE64.encode(text));
        page.replace(&format!("\"./{name}\""), &inside)
    });
    page.replace(r#"<script type="module" src="view.js"></script>"#, &program)
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, Pose, Scene, go2};

    use super::*;

    #[test]
    fn page_refers_to_no_other_file_and_its_title_cannot_end_a_script() {
        let robot = go2();
        let scene = Scene::new(&robot, Pose::IDENTITY, &robot.control.default_pose_f32(), &Ground::FLAT);
        let info = SceneInfo::new("</script><b>walk", &scene, &robot);
        let page = static_page(&info, &[Frame::default()]);
        assert!(!page.contains("src=") && !page.contains("href="), "it refers to another file");
        assert!(page.contains(r"\u003c/script>\u003cb>walk") && !page.contains("</script><b>walk"));
        // The import map, the data, and the program.
        assert_eq!(page.matches("</script>").count(), 3);
    }
}
