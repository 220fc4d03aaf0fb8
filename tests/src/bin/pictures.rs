//! Makes the pictures of the documents again, with the program beside it: `pictures`, or `pictures view_policy` for one.
//!
//! It needs Chromium. The pages are those that a user sees, drawn by its software renderer.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use twinstep_tests::browser::browser;
use twinstep_tests::chrome_page::ChromePage;
use twinstep_tests::python::root;

const PATIENCE: Duration = Duration::from_mins(10);
/// Simulated time that a page shows.
const TIME: &str = "Number(document.querySelector('#facts tr:nth-child(2) td:nth-child(2)').innerText.split(' ')[0])";

/// Picture of a page that a command serves.
struct Picture {
    name: &'static str,
    /// Arguments of `twinstep`.
    command: &'static [&'static str],
    size: [u32; 2],
    /// JavaScript that the page runs first.
    prepare: &'static str,
    /// JavaScript that is true when the picture is taken.
    ready: fn() -> String,
}

const PICTURES: [Picture; 7] = [
    Picture {
        name: "view_policy",
        command: &["view", "data/policies/walk.safetensors", "--robots", "16"],
        size: [1300, 800],
        prepare: "document.getElementById('vx').value = 0.6; document.getElementById('vx').oninput()",
        ready: || format!("{TIME} > 12"),
    },
    Picture {
        name: "view_policy_400",
        command: &["view", "data/policies/walk.safetensors", "--robots", "1"],
        size: [400, 800],
        prepare: "document.getElementById('vx').value = 0.6; document.getElementById('vx').oninput()",
        ready: || format!("{TIME} > 12"),
    },
    Picture {
        name: "robots",
        command: &["view", "data/policies/walk.safetensors", "--robots", "64"],
        size: [1200, 800],
        prepare: "for (const id of ['panel', 'controls', 'stick', 'help', 'status']) document.getElementById(id).style.display \
                  = 'none'; dispatchEvent(new Event('resize')); for (let turn = 0; turn < 24; turn += 1) \
                  document.getElementById('scene').dispatchEvent(new WheelEvent('wheel', { deltaY: 100, bubbles: true, \
                  cancelable: true }))",
        ready: || format!("{TIME} > 1.5"),
    },
    Picture {
        name: "view_stairs",
        command: &["view", "data/policies/walk_terrain.safetensors", "--ground", "stairs=0.12", "--robots", "2"],
        size: [1300, 800],
        prepare: "0",
        ready: || format!("{TIME} > 3"),
    },
    Picture {
        name: "view_log",
        command: &["view", "data/go2_air_chirp", "--model", "go2"],
        size: [1300, 800],
        prepare: "document.getElementById('seek').value = 4; document.getElementById('seek').oninput()",
        ready: || format!("{TIME} > 6"),
    },
    Picture {
        name: "view_train",
        command: &["train", "walk", "--steps", "6000000", "--view", "127.0.0.1:0", "--out"],
        size: [1300, 800],
        prepare: "0",
        ready: || "Number(document.body.dataset.learningPoints) > 150".to_owned(),
    },
    Picture {
        name: "view_g1",
        command: &["view", "g1"],
        size: [1300, 800],
        prepare: "0",
        ready: || format!("{TIME} > 5"),
    },
];

fn main() {
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    if let Some(unknown) = wanted.iter().find(|name| PICTURES.iter().all(|picture| picture.name != **name)) {
        eprintln!("there is no picture `{unknown}`: {}", PICTURES.map(|picture| picture.name).join(", "));
        std::process::exit(2);
    }
    let Some(browser) = browser() else {
        eprintln!("there is no Chromium on the PATH");
        std::process::exit(2);
    };
    for picture in PICTURES.iter().filter(|picture| wanted.is_empty() || wanted.iter().any(|name| name == picture.name))
    {
        let path = root().join("docs/images").join(picture.name).with_extension("png");
        std::fs::write(&path, picture.take(&browser)).expect("the picture is written");
        println!("{}", path.display());
    }
}

impl Picture {
    /// Returns the picture as PNG.
    fn take(&self, browser: &Path) -> Vec<u8> {
        let folder = tempfile::tempdir().expect("a folder");
        let mut arguments: Vec<String> = self.command.iter().map(ToString::to_string).collect();
        match self.command[0] {
            "train" => arguments.push(folder.path().join("training").display().to_string()),
            _ => arguments.extend(["--listen", "127.0.0.1:0"].map(str::to_owned)),
        }
        let served = Served::start(&arguments);
        let mut page = ChromePage::open(browser, &served.url, self.size);
        page.wait_for("Number(document.body.dataset.frames) > 1", PATIENCE);
        page.evaluate(self.prepare);
        page.wait_for(&(self.ready)(), PATIENCE);
        BASE64.decode(page.screenshot()).expect("base64")
    }
}

/// A command whose page is open; killed when dropped.
struct Served {
    child: Child,
    url: String,
}

impl Served {
    fn start(arguments: &[String]) -> Self {
        let program: PathBuf = std::env::current_exe().expect("a program").with_file_name("twinstep");
        let mut child = Command::new(program)
            .args(arguments)
            .current_dir(root())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("`cargo build --release` makes twinstep");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let url = lines.find_map(|line| Some(line.ok()?.strip_prefix("the robots are at ")?.to_owned()));
        // Nobody may block on the pipe.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, url: url.expect("the command prints the address of its page") }
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
