//! What a page looks like in a real browser, without a window.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde::Deserialize;

/// Names of the browser.
const NAMES: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];
/// Width and height of the window [px].
const WINDOW: &str = "1200,900";

/// Measures the page when it stands, and leaves the numbers in it.
const MEASURE: &str = r#"<script>addEventListener("load", () => {
    const boxes = [...document.querySelectorAll("svg")].map((svg) => svg.getBoundingClientRect());
    const numbers = {
        pictures: boxes.length,
        flat_pictures: boxes.filter((box) => box.width < 20 || box.height < 20).length,
        overhang_px: document.documentElement.scrollWidth - document.documentElement.clientWidth,
        height_px: document.documentElement.scrollHeight,
        requests: performance.getEntriesByType("resource").length,
        heading: document.querySelector("h1").innerText,
    };
    document.documentElement.innerHTML = "<pre>" + JSON.stringify(numbers) + "</pre>";
});</script>"#;

/// A page as it stands in a window.
#[derive(Debug, Deserialize)]
pub struct Layout {
    /// Number of its SVGs.
    pub pictures: usize,
    /// Those that have no size to speak of.
    pub flat_pictures: usize,
    /// By how much it is wider than the window [px].
    pub overhang_px: f64,
    /// Its height [px].
    pub height_px: f64,
    /// What it asked the network, or the disk, for.
    pub requests: usize,
    /// What stands first.
    pub heading: String,
}

/// The browser of this machine, if there is one.
pub fn browser() -> Option<PathBuf> {
    let folders: Vec<PathBuf> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    NAMES.iter().flat_map(|name| folders.iter().map(move |folder| folder.join(name))).find(|path| path.is_file())
}

/// How `page` stands in `browser`.
///
/// # Panics
/// If the browser does not run, or the page cannot be measured.
pub fn layout(browser: &Path, page: &Path) -> Layout {
    let folder = tempfile::tempdir().expect("a folder");
    let copy = folder.path().join("page.html");
    let html = std::fs::read_to_string(page).expect("a page");
    // A report forbids scripts; the one that measures has to run.
    let open = html.replace("http-equiv=\"Content-Security-Policy\"", "");
    std::fs::write(&copy, format!("{open}{MEASURE}")).expect("written");
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=10000", "--dump-dom"])
        .arg(format!("--window-size={WINDOW}"))
        .arg(format!("--user-data-dir={}", folder.path().join("profile").display()))
        .arg(format!("file://{}", copy.display()))
        .output()
        .expect("the browser runs");
    let dom = String::from_utf8_lossy(&output.stdout).into_owned();
    let numbers = dom.split_once("<pre>").and_then(|(_, rest)| rest.split_once("</pre>")).map(|(numbers, _)| numbers);
    let numbers = numbers.unwrap_or_else(|| panic!("{dom} {}", String::from_utf8_lossy(&output.stderr)));
    serde_json::from_str(numbers).expect("numbers of a page")
}
