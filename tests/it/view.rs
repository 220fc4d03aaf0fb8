//! `twinstep view` in a real browser, and its web server.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_model::{ResetRequest, VecEnv};
use twinstep_tests::browser::browser;
use twinstep_tests::chrome_page::ChromePage;
use twinstep_tests::python::{Programs, root};

const PATIENCE: Duration = Duration::from_mins(2);

fn program() -> PathBuf {
    Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep()
}

/// A command whose page is open; killed when dropped.
struct Viewed {
    child: std::process::Child,
    url: String,
    /// First line on stdout of a server; empty for other commands. The rest is not read: stdout is closed.
    first_line: String,
}

impl Viewed {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(program())
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = std::io::BufRead::lines(std::io::BufReader::new(child.stderr.take().unwrap()));
        let url = lines.find_map(|line| line.unwrap().strip_prefix("the robots are at ").map(str::to_owned));
        // Nobody may block on the pipe.
        std::thread::spawn(move || lines.for_each(drop));
        let mut output = std::io::BufRead::lines(std::io::BufReader::new(child.stdout.take().unwrap()));
        let first_line = if arguments[0] == "serve" { output.next().unwrap().unwrap() } else { String::new() };
        Self { child, url: url.expect("the command prints an address"), first_line }
    }

    fn policy() -> Self {
        let policy = root().join("data/policies/walk.safetensors");
        Self::start(&["view", policy.to_str().unwrap(), "--listen", "127.0.0.1:0"])
    }

    /// Endpoint of a server, from its first line.
    fn endpoint(&self) -> &str {
        self.first_line.trim_start_matches("listening ")
    }

    fn address(&self) -> &str {
        self.url.trim_start_matches("http://").trim_end_matches('/')
    }

    /// Sends a request and returns the whole answer, from its status line on.
    fn http(&self, request: &str) -> String {
        let mut stream = TcpStream::connect(self.address()).unwrap();
        let request = request.replacen("\r\n\r\n", "\r\nConnection: close\r\n\r\n", 1);
        stream.write_all(request.as_bytes()).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    }

    /// Sends the request of a page, and returns the beginning of the answer.
    fn ask(&self, body: &str) -> String {
        let len = body.len();
        let kind = "application/json";
        self.http(&format!(
            "POST /request HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\nContent-Length: {len}\r\n\r\n{body}"
        ))
    }

    /// Waits for a frame whose header is as wanted.
    fn wait_for_frame(&self, wanted: impl Fn(&serde_json::Value) -> bool) {
        let mut page = TcpStream::connect(self.address()).unwrap();
        page.write_all(b"GET /frames HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        page.set_read_timeout(Some(PATIENCE)).unwrap();
        let (mut bytes, mut buffer, since) = (Vec::new(), vec![0; 1 << 16], Instant::now());
        while since.elapsed() < PATIENCE {
            let len = page.read(&mut buffer).unwrap();
            assert!(len > 0, "the page ended");
            bytes.extend_from_slice(&buffer[..len]);
            // A header is one line of JSON between binary numbers.
            let starts = bytes.windows(8).enumerate().filter(|(_, text)| *text == br#"{"time":"#).map(|(at, _)| at);
            let headers = starts.filter_map(|at| serde_json::Deserializer::from_slice(&bytes[at..]).into_iter().next());
            if headers.filter_map(Result::ok).any(|header| wanted(&header)) {
                return;
            }
            let newest = bytes.len().saturating_sub(1 << 20);
            bytes.drain(..newest);
        }
        panic!("no such frame within {PATIENCE:?}");
    }
}

impl Drop for Viewed {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn page_draws_a_walking_robot_and_its_controls_work() {
    let Some(browser) = browser() else { return };
    let viewed = Viewed::policy();
    let mut page = ChromePage::open(&browser, &viewed.url, [1000, 700]);
    page.wait_for("Number(document.body.dataset.frames) > 5", PATIENCE);
    println!("first frame {} ms after opening", page.evaluate("document.body.dataset.firstFrameMs"));
    page.evaluate("document.getElementById('vx').value = 0.5; document.getElementById('vx').oninput()");
    page.wait_for("document.getElementById('facts').innerText.includes('0.50 0.00 0.00')", PATIENCE);
    let time = "Number(document.querySelector('#facts tr:nth-child(2) td:nth-child(2)').innerText.split(' ')[0])";
    let before = page.evaluate(time).as_f64().unwrap();
    page.wait_for(&format!("{time} > {}", before + 1.0), PATIENCE);
    page.evaluate("document.getElementById('pause').click()");
    page.wait_for("document.getElementById('pause').innerText == 'play'", PATIENCE);
    let paused = page.evaluate(time).as_f64().unwrap();
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(page.evaluate(time).as_f64().unwrap(), paused, "it stands still");
    page.evaluate("document.getElementById('push').click()");
    assert!(page.screenshot().len() > 10_000, "a picture");
    let loaded =
        page.evaluate("performance.getEntriesByType('resource').every((one) => one.name.startsWith(location.origin))");
    assert_eq!(loaded, true, "nothing is loaded from elsewhere");
}

#[test]
fn robot_is_pushed_with_the_mouse_steered_with_the_stick_and_its_reward_terms_are_curves() {
    let Some(browser) = browser() else { return };
    let viewed = Viewed::policy();
    let mut page = ChromePage::open(&browser, &viewed.url, [1000, 700]);
    page.wait_for("Number(document.body.dataset.frames) > 5", PATIENCE);
    for curve in ["forward [m/s]", "force of the ground", "track_linear_velocity", "largest torque [N·m]", "falls"] {
        page.wait_for(&format!("document.getElementById('curves').textContent.includes('{curve}')"), PATIENCE);
    }
    // The pointer over a curve shows the values at that time; the robot stood in the beginning.
    let shown = "document.querySelector('#curves b:last-child').innerText";
    page.wait_for("document.querySelector('#curves canvas').clientWidth > 100", PATIENCE);
    page.evaluate(
        "(() => { const box = document.querySelector('#curves canvas').getBoundingClientRect();
         document.querySelector('#curves canvas').dispatchEvent(new PointerEvent('pointermove', { bubbles: true,
         clientX: box.left + 46, clientY: box.top + 5 })) })()",
    );
    page.wait_for(&format!("Math.abs(Number({shown})) < 0.2"), PATIENCE);
    // The stick: half of its radius up is half of the largest velocity forward.
    let place = page.evaluate(
        "(() => { const box = document.getElementById('stick').getBoundingClientRect(); \
         return [box.left + box.width / 2, box.top + box.height / 2, box.width / 2] })()",
    );
    let [x, y, radius] = [0, 1, 2].map(|index| place[index].as_f64().unwrap());
    let half = [x, y - 0.5 * radius];
    page.press_and_move(&[[x, y], [x, y - 0.25 * radius], half]);
    page.wait_for("document.getElementById('facts').innerText.includes('0.50 0.00 0.00')", PATIENCE);
    page.release(half);
    page.wait_for("document.getElementById('facts').innerText.includes('0.00 0.00 0.00')", PATIENCE);
    // The camera follows the robot, so that its trunk is in the middle of what the panel leaves free.
    let size = page.evaluate("[innerWidth - document.getElementById('panel').clientWidth, innerHeight]");
    let [x, y] = [0, 1].map(|index| size[index].as_f64().unwrap() / 2.0);
    page.evaluate(
        "globalThis.requests = []; const send = fetch; \
         globalThis.fetch = (path, options) => { if (options?.body) requests.push(options.body); return send(path, options) }",
    );
    let place = [x + 90.0, y];
    page.press_and_move(&[[x, y], [x + 30.0, y], place]);
    page.wait_for("document.getElementById('push-size').textContent.includes('push: ')", PATIENCE);
    page.release(place);
    page.wait_for("requests.some((body) => body.includes('push'))", PATIENCE);
    let body = page.evaluate("requests.find((body) => body.includes('push'))");
    let push: serde_json::Value = serde_json::from_str(body.as_str().unwrap()).unwrap();
    let velocity: Vec<f64> = (0..3).map(|axis| push["push"]["velocity"][axis].as_f64().unwrap()).collect();
    // The camera begins at (1.4, -1.6) m: to its right is the direction (1.6, 1.4), whatever the robot did before.
    let right = (1.6 * velocity[0] + 1.4 * velocity[1]) / 1.6_f64.hypot(1.4);
    assert!((0.3..3.01).contains(&right) && velocity[2] == 0.0, "{velocity:?}");
}

#[test]
fn log_and_its_simulation_are_drawn_on_top_of_each_other() {
    let Some(browser) = browser() else { return };
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("nominal.toml");
    std::fs::write(&model, "robot = \"go2\"\n").unwrap();
    let log = root().join("data/go2_air_chirp");
    let (log, model) = (log.to_str().unwrap(), model.to_str().unwrap());
    let viewed = Viewed::start(&["view", log, "--model", model, "--listen", "127.0.0.1:0"]);
    let mut page = ChromePage::open(&browser, &viewed.url, [1000, 700]);
    page.wait_for("document.getElementById('facts').innerText.includes('simulated trunk is off by')", PATIENCE);
    page.wait_for("document.getElementById('curves').innerText.includes('FL_calf error [rad]')", PATIENCE);
    page.evaluate("document.getElementById('seek').value = 5; document.getElementById('seek').oninput()");
    let time = "document.querySelector('#facts tr:nth-child(2) td:nth-child(2)').innerText";
    page.wait_for(&format!("Number({time}.split(' ')[0]) >= 5"), PATIENCE);
}

#[test]
fn file_plays_the_motion_of_a_policy_or_a_log_without_a_program() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("motion.html");
    let (policy, log) = (root().join("data/policies/walk.safetensors"), root().join("data/go2_air_chirp"));
    for target in [policy, log] {
        let (target, file) = (target.to_str().unwrap(), file.to_str().unwrap());
        let arguments = ["view", target, "--html", file, "--seconds", "3"];
        let output = Command::new(program()).args(arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let Some(browser) = browser() else { return };
        let mut page = ChromePage::open(&browser, &format!("file://{file}"), [1000, 700]);
        page.wait_for("Number(document.body.dataset.frames) > 5", PATIENCE);
        let time = "Number(document.querySelector('#facts tr:nth-child(2) td:nth-child(2)').innerText.split(' ')[0])";
        page.wait_for(&format!("{time} >= 2.9"), PATIENCE);
        page.wait_for("document.getElementById('pause').innerText == 'play'", PATIENCE);
        page.evaluate("document.getElementById('seek').value = 1; document.getElementById('seek').oninput()");
        page.wait_for(&format!("{time} < 1.1"), PATIENCE);
        page.wait_for("document.getElementById('curves').innerText.length > 20", PATIENCE);
        assert_eq!(page.evaluate("performance.getEntriesByType('resource').length"), 0, "it loads nothing");
    }
    let endpoint = ["view", "tcp/127.0.0.1:9", "--html", "motion.html"];
    let output = Command::new(program()).args(endpoint).output().unwrap();
    assert!(output.status.code() == Some(2) && String::from_utf8_lossy(&output.stderr).contains("--log"));
}

#[test]
fn recording_for_foxglove_has_the_frames_of_the_robot_and_of_its_simulation() {
    let folder = tempfile::tempdir().unwrap();
    let (file, model) = (folder.path().join("motion.mcap"), folder.path().join("nominal.toml"));
    std::fs::write(&model, "robot = \"go2\"\n").unwrap();
    let log = root().join("data/go2_air_chirp");
    let arguments = ["view", log.to_str().unwrap(), "--model", model.to_str().unwrap(), "--seconds", "1"];
    let output = Command::new(program()).args(arguments).args(["--mcap", file.to_str().unwrap()]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let bytes = std::fs::read(&file).unwrap();
    let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
    let of = |topic: &str| messages.iter().filter(|message| message.channel.topic == topic).collect::<Vec<_>>();
    assert_eq!((of("/scene").len(), of("/tf").len(), of("/curves").len()), (1, 31, 31));
    let has = |bytes: &[u8], text: &str| bytes.windows(text.len()).any(|part| part == text.as_bytes());
    for name in ["robot_0/FL_calf", "ghost_0/FL_calf", "robot_0/trunk"] {
        assert!(has(&of("/scene")[0].data, name) && has(&of("/tf")[10].data, name), "{name}");
    }
    let curves: serde_json::Value = serde_json::from_slice(&of("/curves")[30].data).unwrap();
    assert!(curves["FL_calf error [rad]"].as_f64().is_some_and(|error| error.abs() < 0.5), "{curves}");
    let robot: serde_json::Value = serde_json::from_slice(&of("/robot_0")[30].data).unwrap();
    assert_eq!(robot, serde_json::json!({}), "the log has neither forces nor the torques of all joints");
}

#[test]
fn page_of_another_site_gets_nothing_and_cannot_move_the_robots() {
    let viewed = Viewed::policy();
    let local = viewed.http("GET /scene HTTP/1.1\r\nHost: localhost:7480\r\n\r\n");
    assert!(local.starts_with("HTTP/1.1 200") && local.contains("torque_limits"), "{local}");
    let foreign = viewed.http("GET /scene HTTP/1.1\r\nHost: evil.example\r\n\r\n");
    assert!(foreign.starts_with("HTTP/1.1 403"), "{foreign}");
    let body = r#"{"reset":null}"#;
    let post = |kind: &str| {
        let len = body.len();
        format!(
            "POST /request HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\nContent-Length: {len}\r\n\r\n{body}"
        )
    };
    // A form of another site can send text, but not JSON.
    assert!(viewed.http(&post("text/plain")).starts_with("HTTP/1.1 415"));
    assert!(viewed.http(&post("application/json")).starts_with("HTTP/1.1 204"));
    let wrong = "POST /request HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 13\r\n\r\n{\"fly\":\"high\"}";
    assert!(viewed.http(wrong).starts_with("HTTP/1.1 4"), "{}", viewed.http(wrong));
}

#[test]
fn page_that_others_can_reach_has_a_token_and_shows_its_robot() {
    let policy = root().join("data/policies/walk.safetensors");
    let viewed = Viewed::start(&["view", policy.to_str().unwrap(), "--listen", "0.0.0.0:0"]);
    let (address, token) = viewed.url.trim_start_matches("http://").split_once("/?token=").expect("a token");
    assert!(token.len() >= 32, "{}", viewed.url);
    let port = address.rsplit_once(':').unwrap().1;
    let ask = |path: &str| {
        let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).unwrap();
        stream
            .write_all(format!("GET {path} HTTP/1.1\r\nHost: robot\r\nConnection: close\r\n\r\n").as_bytes())
            .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).chars().take(12).collect::<String>()
    };
    for file in ["/", "/view.js", "/recording.js", "/view.css", "/three.min.js"] {
        assert_eq!(ask(file), "HTTP/1.1 200", "{file}");
    }
    for path in ["/scene", "/learning"] {
        assert_eq!(ask(path), "HTTP/1.1 403", "{path}");
        assert_eq!(ask(&format!("{path}?token={token}")), "HTTP/1.1 200", "{path}");
    }
    let Some(browser) = browser() else { return };
    let url = format!("http://127.0.0.1:{port}/?token={token}");
    let mut page = ChromePage::open(&browser, &url, [1000, 700]);
    page.wait_for("Number(document.body.dataset.frames) > 5", PATIENCE);
}

#[test]
fn token_that_can_be_guessed_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("token");
    let policy = root().join("data/policies/walk.safetensors");
    for token in ["", "1234567\n"] {
        std::fs::write(&file, token).unwrap();
        let output = Command::new(program())
            .args(["view", policy.to_str().unwrap(), "--listen", "0.0.0.0:0", "--token-file"])
            .arg(&file)
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && text.contains("characters"), "{text}");
    }
    let missing = Command::new(program()).args(["view", "no/such/file"]).output().unwrap();
    assert!(missing.status.code() == Some(2) && String::from_utf8_lossy(&missing.stderr).contains("no/such/file"));
}

#[test]
fn connections_that_ask_for_nothing_are_closed_and_few() {
    let viewed = Viewed::policy();
    let idle: Vec<TcpStream> = (0..300).map(|_| TcpStream::connect(viewed.address()).unwrap()).collect();
    let files = || std::fs::read_dir(format!("/proc/{}/fd", viewed.child.id())).unwrap().count();
    std::thread::sleep(Duration::from_millis(500));
    assert!(files() < 120, "{} open files", files());
    let since = Instant::now();
    // Those that are open are closed after 5 s without a request.
    std::thread::sleep(Duration::from_secs(6));
    assert!(viewed.http("GET /scene HTTP/1.1\r\nHost: localhost\r\n\r\n").starts_with("HTTP/1.1 200"));
    assert!(since.elapsed() < Duration::from_secs(30));
    drop(idle);
}

#[test]
fn policy_that_follows_a_path_is_shown_in_its_task() {
    let policy = root().join("data/policies/track.safetensors");
    let viewed = Viewed::start(&["view", policy.to_str().unwrap(), "--listen", "127.0.0.1:0"]);
    viewed.wait_for_frame(|header| header["robots"] == 1);
}

#[test]
fn robots_that_learn_are_seen() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("walk");
    let viewed = Viewed::start(&["train", "walk", "--out", out.to_str().unwrap(), "--view", "127.0.0.1:0"]);
    // 64 of the 128 of the first group.
    viewed.wait_for_frame(|header| header["robots"] == 64 && header["curves"]["reward per step"].is_number());
    // A page that is opened late, or again, has the whole learning curve.
    let points = || {
        let answer = viewed.http("GET /learning HTTP/1.1\r\nHost: localhost\r\n\r\n");
        let body = answer.split_once("\r\n\r\n").unwrap().1;
        serde_json::from_str::<Vec<serde_json::Value>>(body).unwrap_or_default()
    };
    let since = Instant::now();
    while points().len() < 3 {
        assert!(since.elapsed() < 4 * PATIENCE, "{:?}", points());
        std::thread::sleep(Duration::from_millis(100));
    }
    let first = &points()[0];
    assert!(first["reward"].is_number() && first["env_steps"].as_u64().unwrap() < 1_000_000, "{first}");
    let Some(browser) = browser() else { return };
    let mut page = ChromePage::open(&browser, &viewed.url, [1000, 700]);
    for _ in 0..2 {
        page.wait_for("Number(document.body.dataset.learningPoints) >= 3", PATIENCE);
        page.wait_for("document.getElementById('learning').innerText.includes('falls per minute and robot')", PATIENCE);
        page.reload();
    }
}

#[test]
fn sliders_of_the_page_steer_a_run_and_nothing_else_of_it_can_be_changed() {
    let server = Viewed::start(&["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "1", "--view", "127.0.0.1:0"]);
    let policy = root().join("data/policies/walk.safetensors");
    let arguments = ["run", policy.to_str().unwrap(), "--endpoint", server.endpoint(), "--view", "127.0.0.1:0"];
    let viewed = Viewed::start(&arguments);
    let command = |header: &serde_json::Value| {
        let curve = |name: &str| header["curves"][name].as_f64();
        Some(curve("forward [m/s]")? + curve("error, forward [m/s]")?)
    };
    viewed.wait_for_frame(|header| command(header).is_some());
    assert!(viewed.ask(r#"{"pause":true}"#).starts_with("HTTP/1.1 409"));
    assert!(viewed.ask(r#"{"push":{"robot":0,"velocity":[1,0,0]}}"#).starts_with("HTTP/1.1 409"));
    // The largest command is 1 m/s.
    for (velocity, expected) in [("[0.4,0,0]", 0.4), ("[9,0,0]", 1.0)] {
        let is_over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            // As a page does: a velocity holds for 2 s.
            scope.spawn(|| {
                while !is_over.load(Ordering::Acquire) {
                    assert!(viewed.ask(&format!("{{\"velocity\":{velocity}}}")).starts_with("HTTP/1.1 204"));
                    std::thread::sleep(Duration::from_millis(300));
                }
            });
            viewed.wait_for_frame(|header| command(header).is_some_and(|command| (command - expected).abs() < 1e-5));
            is_over.store(true, Ordering::Release);
        });
    }
    // No page repeats it.
    viewed.wait_for_frame(|header| command(header).is_some_and(|command| command.abs() < 1e-5));
    let Some(browser) = browser() else { return };
    let mut page = ChromePage::open(&browser, &viewed.url, [1000, 700]);
    page.wait_for("Number(document.body.dataset.frames) > 5", PATIENCE);
    let groups = "['playback', 'velocity', 'robots'].map((group) => document.getElementById(group).hidden).join()";
    assert_eq!(page.evaluate(groups), "true,false,true");
    let is_half = |header: &serde_json::Value| command(header).is_some_and(|command| (command - 0.5).abs() < 1e-5);
    page.evaluate("document.getElementById('vx').value = 0.5; document.getElementById('vx').oninput()");
    viewed.wait_for_frame(is_half);
    // Longer than a run waits for a page.
    std::thread::sleep(Duration::from_secs(3));
    viewed.wait_for_frame(is_half);
    drop(page);
    viewed.wait_for_frame(|header| command(header).is_some_and(|command| command.abs() < 1e-5));
}

#[test]
fn robot_is_seen_without_a_client() {
    let mut viewed = Viewed::start(&["robot", "--fake", "--listen", "tcp/127.0.0.1:0", "--view", "127.0.0.1:0"]);
    // Nobody reads its stdout any more, which must not end a process that holds a robot.
    viewed.child.stdin.as_mut().unwrap().write_all(b"status\n").unwrap();
    viewed
        .wait_for_frame(|header| header["curves"]["supply voltage [V]"].as_f64().is_some_and(|voltage| voltage > 20.0));
    assert!(viewed.ask(r#"{"velocity":[0.5,0,0]}"#).starts_with("HTTP/1.1 409"), "it is looked at only");
}

#[test]
fn robots_of_a_lease_are_seen_while_an_agent_steps_them() {
    let viewed = Viewed::start(&["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "3", "--view", "127.0.0.1:0"]);
    let options = ConnectOptions::new(viewed.endpoint(), 3);
    let mut env = RemoteVecEnv::connect(&options).unwrap();
    env.reset(&ResetRequest::seeded(1, 3)).unwrap();
    let mut page = TcpStream::connect(viewed.address()).unwrap();
    page.write_all(b"GET /frames HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    page.set_read_timeout(Some(Duration::from_millis(5))).unwrap();
    let (mut bytes, mut buffer, since) = (Vec::new(), vec![0; 1 << 16], Instant::now());
    let has_robots = |bytes: &[u8]| String::from_utf8_lossy(bytes).contains("\"robots\":3");
    while !has_robots(&bytes) && since.elapsed() < PATIENCE {
        env.step(&[0.0; 36]).unwrap();
        let len = page.read(&mut buffer).unwrap_or(0);
        bytes.extend_from_slice(&buffer[..len]);
    }
    assert!(has_robots(&bytes), "{} bytes without a frame of three robots", bytes.len());
    let answer = viewed.ask(r#"{"reset":null}"#);
    assert!(answer.starts_with("HTTP/1.1 409"), "they are looked at only: {answer}");
}

#[test]
fn robots_of_another_process_are_seen_through_its_endpoint() {
    let server = Viewed::start(&["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "3", "--view", "127.0.0.1:0"]);
    let mut viewed = Viewed::start(&["view", server.endpoint(), "--listen", "127.0.0.1:0"]);
    let options = ConnectOptions::new(server.endpoint(), 3);
    let is_over = Arc::new(AtomicBool::new(false));
    let end = Arc::clone(&is_over);
    let agent = std::thread::spawn(move || {
        let mut env = RemoteVecEnv::connect(&options).unwrap();
        env.reset(&ResetRequest::seeded(1, 3)).unwrap();
        while !end.load(Ordering::Acquire) {
            env.step(&[0.0; 36]).unwrap();
        }
    });
    let scene = viewed.http("GET /scene HTTP/1.1\r\nHost: localhost\r\n\r\n");
    assert!(scene.contains(server.endpoint()) && scene.contains("\"velocity_bounds\":null"), "{scene}");
    viewed.wait_for_frame(|header| header["robots"] == 3 && header["curves"]["reward per step"].is_number());
    assert!(viewed.ask(r#"{"reset":null}"#).starts_with("HTTP/1.1 409"), "they are looked at only");
    is_over.store(true, Ordering::Release);
    agent.join().unwrap();
    drop(server);
    let since = Instant::now();
    let status = loop {
        if let Some(status) = viewed.child.try_wait().unwrap() {
            break status;
        }
        assert!(since.elapsed() < PATIENCE, "the view goes on without its server");
        std::thread::sleep(Duration::from_millis(50));
    };
    assert_eq!(status.code(), Some(1));
}

#[test]
fn page_that_stops_reading_does_not_stop_the_robots() {
    let policy = root().join("data/policies/walk.safetensors");
    let viewed = Viewed::start(&["view", policy.to_str().unwrap(), "--robots", "64", "--listen", "127.0.0.1:0"]);
    let mut silent = TcpStream::connect(viewed.address()).unwrap();
    silent.write_all(b"GET /frames HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    // A second page sees the time go on, long after the buffers of the silent one are full.
    let mut reader = TcpStream::connect(viewed.address()).unwrap();
    reader.write_all(b"GET /frames HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    reader.set_read_timeout(Some(PATIENCE)).unwrap();
    let (mut bytes, mut buffer) = (0, vec![0; 1 << 16]);
    while bytes < 8 << 20 {
        let len = reader.read(&mut buffer).unwrap();
        assert!(len > 0, "the page ended after {bytes} bytes");
        bytes += len;
    }
}
