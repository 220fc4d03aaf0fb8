//! Layout of an HTML page in a real browser, without a visible window.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde::Deserialize;

/// Program names of supported browsers.
const NAMES: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];
/// Width and height of the window [px].
const WINDOW: &str = "1200,900";

/// Script that measures the page after it has loaded and replaces its content by the numbers.
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

/// Measured layout of a page.
#[derive(Debug, Deserialize)]
pub struct Layout {
    /// Number of SVG elements.
    pub pictures: usize,
    /// Number of SVG elements narrower or lower than 20 px.
    pub flat_pictures: usize,
    /// Width beyond that of the window [px].
    pub overhang_px: f64,
    /// Height of the page [px].
    pub height_px: f64,
    /// Number of resources loaded from the network or the disk.
    pub requests: usize,
    /// Text of the first `h1`.
    pub heading: String,
}

/// Returns the first browser on the `PATH`, or `None` if none is installed.
pub fn browser() -> Option<PathBuf> {
    let folders: Vec<PathBuf> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    NAMES.iter().flat_map(|name| folders.iter().map(move |folder| folder.join(name))).find(|path| path.is_file())
}

/// Measures the layout of `page` in `browser`.
///
/// # Panics
/// If the browser does not run, or the page cannot be measured.
pub fn layout(browser: &Path, page: &Path) -> Layout {
    let folder = tempfile::tempdir().expect("a folder");
    let copy = folder.path().join("page.html");
    let html = std::fs::read_to_string(page).expect("a page");
    // The report's content security policy forbids scripts, but the measuring script must run.
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
