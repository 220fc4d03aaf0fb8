//! A page in a real browser without a visible window, driven by the DevTools protocol.

use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

/// An open page. The browser ends when the value is dropped.
pub struct ChromePage {
    child: Child,
    to: File,
    from: BufReader<File>,
    next_id: u64,
    session: Option<String>,
    _folder: tempfile::TempDir,
}

impl ChromePage {
    /// Opens `url` in `browser`, with a software renderer.
    ///
    /// # Panics
    /// If the browser does not run.
    pub fn open(browser: &Path, url: &str, size: [u32; 2]) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let file = |name: &str| folder.path().join(name).display().to_string();
        let (input, output) = (file("input"), file("output"));
        assert!(Command::new("mkfifo").args([&input, &output]).status().expect("mkfifo runs").success());
        // The browser reads from file descriptor 3 and writes to 4.
        let command = format!(
            "exec {} --headless --no-sandbox --disable-dev-shm-usage --remote-debugging-pipe --user-data-dir={} \
             --use-angle=swiftshader --enable-unsafe-swiftshader --window-size={},{} --disable-background-networking \
             --disable-sync 3<{input} 4>{output}",
            browser.display(),
            file("profile"),
            size[0],
            size[1],
        );
        let child = Command::new("sh").args(["-c", &command]).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        let child = child.expect("the browser runs");
        let to = File::options().write(true).open(&input).expect("the browser's input");
        let from = BufReader::new(File::open(&output).expect("the browser's output"));
        let mut page = Self { child, to, from, next_id: 0, session: None, _folder: folder };
        let target = page.call("Target.createTarget", json!({ "url": url }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let session = page.call("Target.attachToTarget", attach);
        page.session = session["sessionId"].as_str().map(str::to_owned);
        page
    }

    /// Calls a method of the DevTools protocol and returns its result.
    fn call(&mut self, method: &str, params: Value) -> Value {
        self.next_id += 1;
        let id = self.next_id;
        let mut message = json!({ "id": id, "method": method, "params": params });
        if let Some(session) = &self.session {
            message["sessionId"] = session.as_str().into();
        }
        let bytes = [message.to_string().as_bytes(), b"\0"].concat();
        self.to.write_all(&bytes).expect("the browser reads");
        loop {
            let mut answer = Vec::new();
            self.from.read_until(0, &mut answer).expect("the browser answers");
            answer.pop();
            let answer: Value = serde_json::from_slice(&answer).expect("the browser answers in JSON");
            if answer["id"] == id {
                assert!(answer.get("error").is_none(), "{method}: {answer}");
                return answer["result"].clone();
            }
        }
    }

    /// Returns the value of a JavaScript expression.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let params = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let result = self.call("Runtime.evaluate", params);
        assert!(result.get("exceptionDetails").is_none(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Waits until an expression is true. Panics after `timeout`.
    pub fn wait_for(&mut self, expression: &str, timeout: Duration) {
        let end = Instant::now() + timeout;
        // The page may have no elements yet.
        let careful = format!("(() => {{ try {{ return {expression} }} catch {{ return false }} }})()");
        while self.evaluate(&careful) != true {
            assert!(
                Instant::now() < end,
                "`{expression}` did not become true: {}",
                self.evaluate("document.body.innerText")
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Presses the mouse at the first point, and moves it over the others [px]. It stays pressed.
    pub fn press_and_move(&mut self, points: &[[f64; 2]]) {
        for (index, [x, y]) in points.iter().enumerate() {
            let kind = if index == 0 { "mousePressed" } else { "mouseMoved" };
            let event = json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", event);
        }
    }

    /// Releases the mouse at a point [px].
    pub fn release(&mut self, [x, y]: [f64; 2]) {
        let event = json!({ "type": "mouseReleased", "x": x, "y": y, "button": "left", "clickCount": 1 });
        self.call("Input.dispatchMouseEvent", event);
    }

    /// Loads the page again.
    pub fn reload(&mut self) {
        self.call("Page.reload", json!({}));
    }

    /// Returns a picture of the page as base64 of a PNG.
    pub fn screenshot(&mut self) -> String {
        let picture = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        picture["data"].as_str().unwrap_or_default().to_owned()
    }
}

impl Drop for ChromePage {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
