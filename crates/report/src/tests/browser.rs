//! Layout of the page in a real browser, if one is installed.

use std::path::{Path, PathBuf};
use std::process::Command;

use twinstep_effects::ModelFile;
use twinstep_model::BaseMount;

use super::nothing;
use super::samples::{chirp, evidence, findings, recording, simulated, three_joints};
use crate::html::escape;
use crate::page::page;

/// Widths of the tested screens [px].
const WIDTHS: [u32; 3] = [360, 760, 1200];

/// Returns the path of Chromium, under one of its names.
fn browser() -> Option<PathBuf> {
    let folders: Vec<_> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    let names = ["chromium", "chromium-browser", "google-chrome"];
    folders.iter().flat_map(|folder| names.map(|name| folder.join(name))).find(|path| path.is_file())
}

/// Returns a page with frames of several widths that reports the width of each frame and of its content.
fn frames(page: &str) -> String {
    // With the policy of the page, its parent could not read the frame.
    let page = escape(page);
    let frames = WIDTHS.map(|width| format!("<iframe width={width} height=900 srcdoc=\"{page}\"></iframe>")).concat();
    format!(
        "<!doctype html><meta charset=utf-8><body>{frames}<script>
        addEventListener('load', () => {{
            const found = [...document.querySelectorAll('iframe')].map(frame => {{
                const root = frame.contentDocument.documentElement;
                return root.clientWidth + ':' + root.scrollWidth + ':' + root.querySelectorAll('svg').length;
            }});
            document.body.innerHTML = 'widths ' + found.join(' ') + ' end';
        }});
        </script>"
    )
}

fn assert_fits(browser: &Path, name: &str, page: &str) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("frames.html");
    std::fs::write(&file, frames(page)).unwrap();
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"])
        .arg(format!("--user-data-dir={}", folder.path().join("profile").display()))
        .arg(&file)
        .output()
        .unwrap();
    let (dom, log) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(!log.contains("CONSOLE"), "{name}: {log}");
    let found = dom.split("widths ").nth(1).and_then(|rest| rest.split(" end").next());
    let found: Vec<_> = found.unwrap_or_else(|| panic!("{name}: {dom}{log}")).split(' ').collect();
    assert_eq!(found.len(), WIDTHS.len());
    for frame in found {
        let [width, content, pictures] =
            frame.split(':').map(|number| number.parse().unwrap()).collect::<Vec<u32>>()[..].try_into().unwrap();
        assert!(width > 300 && content <= width, "{name}: {content} px of content on {width} px");
        assert!(pictures >= 2, "{name}: {pictures} pictures");
    }
}

#[test]
fn page_fits_narrow_and_wide_screens_without_browser_errors() {
    let Some(browser) = browser() else {
        println!("skipped: no Chromium on the PATH");
        return;
    };
    let (diagnosis, extended) = findings();
    let (log, diagnosis_with_torque, own) = simulated();
    let pages = [
        ("findings", page(&diagnosis, &evidence(&recording(), &extended))),
        ("torque", page(&diagnosis_with_torque, &evidence(&log, &own))),
        ("one leg", page(&nothing(), &evidence(&three_joints(), &extended))),
    ];
    for (name, page) in pages {
        assert_fits(&browser, name, &page);
    }
}

#[test]
#[ignore = "writes pages into the temporary folder, for manual inspection"]
fn pages_for_inspection() {
    let folder = std::env::temp_dir().join("twinstep-report");
    std::fs::create_dir_all(&folder).unwrap();
    let (diagnosis, extended) = findings();
    let (log, diagnosis_with_torque, own) = simulated();
    let write = |name: &str, page: String| std::fs::write(folder.join(name), page).unwrap();
    write("findings.html", page(&diagnosis, &evidence(&recording(), &extended)));
    write("torque.html", page(&diagnosis_with_torque, &evidence(&log, &own)));
    write(
        "nothing.html",
        page(&nothing(), &evidence(&chirp(&ModelFile::default(), BaseMount::Fixed), &ModelFile::default())),
    );
    write("one_leg.html", page(&nothing(), &evidence(&three_joints(), &extended)));
}
