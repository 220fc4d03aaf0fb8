//! What stops `twinstep robot` and its clients, and what does not.

use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use twinstep_model::{ResetRequest, VecEnv};
use twinstep_protocol::keys;
use twinstep_tests::process::{Process, interruptible};
use twinstep_tests::python::{python, root};
use twinstep_tests::robot_pair::{RobotPair, next_domain};

use crate::raw_client::RawClient;
use crate::robot::{client, pair, program, standing, test_in_real_time};

#[test]
fn stop_needs_no_lease_and_damps_at_once() {
    test_in_real_time(|| {
        let mut pair = standing(&[]);
        let mut env = client(&pair);
        env.reset(&ResetRequest::default()).unwrap();
        let stranger = RawClient::connect_to_only_server(&pair.endpoint, "stranger");
        let since = Instant::now();
        stranger.ask(&keys::stop(&stranger.sid), &[]).unwrap();
        pair.wait_for("fault", Duration::from_secs(2)).unwrap();
        assert!(since.elapsed() < Duration::from_millis(500), "{:?}", since.elapsed());
        assert!(pair.state().contains("stopped on request"), "{}", pair.state());
        // The operator arms again; the fault is forgotten.
        pair.insist("arm").unwrap();
        pair.wait_for("damp", Duration::from_secs(2)).unwrap();
        let Some(python) = python(&crate::python::target()).unwrap() else { return };
        let script = format!("import twinstep; twinstep.stop_robot('{}')", pair.endpoint);
        let client = root().join("clients/python/src");
        assert!(Command::new(python).args(["-c", &script]).env("PYTHONPATH", client).status().unwrap().success());
        pair.wait_for("fault", Duration::from_secs(2)).unwrap();
    });
}

#[test]
fn stop_channel_stops_the_robot_beside_connections_that_say_nothing() {
    test_in_real_time(|| {
        let mut pair = standing(&[]);
        let hello = RawClient::connect_to_only_server(&pair.endpoint, "stranger").hello();
        let port = hello.real_time.unwrap().stop_port.unwrap();
        let _idle: Vec<_> = (0..200).map(|_| std::net::TcpStream::connect(("127.0.0.1", port)).unwrap()).collect();
        let since = Instant::now();
        twinstep_client::stop_robot(&pair.endpoint, Some(port), None).unwrap();
        pair.wait_for("fault", Duration::from_secs(2)).unwrap();
        assert!(since.elapsed() < Duration::from_millis(500), "{:?}", since.elapsed());
        assert!(pair.state().contains("stopped on request"), "{}", pair.state());
    });
}

#[test]
fn stop_channel_asks_for_the_password_of_a_user() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let users = file("users.txt", "alice:secret\n");
    let dictionary = format!("{{transport: {{auth: {{usrpwd: {{dictionary_file: \"{}\"}}}}}}}}", users.display());
    let server = file("server.json5", &dictionary);
    let user =
        |password: &str| format!("{{transport: {{auth: {{usrpwd: {{user: \"alice\", password: \"{password}\"}}}}}}}}");
    let (right, wrong) = (file("right.json5", &user("secret")), file("wrong.json5", &user("Secret")));
    let pair = pair(&["--zenoh", server.to_str().unwrap()]);
    let stop = |zenoh: Option<&Path>| {
        twinstep_client::stop_robot(&pair.endpoint, None, zenoh).map_err(|error| error.to_string())
    };
    assert_eq!(stop(Some(&right)), Ok(()));
    for zenoh in [Some(&*wrong), None] {
        assert!(stop(zenoh).unwrap_err().contains("refuses user or password"));
    }
}

#[test]
fn agent_of_before_a_fault_ends_or_waits_for_the_word_of_the_operator() {
    test_in_real_time(|| {
        let mut pair = standing(&[]);
        let policy = root().join("data/policies/walk.safetensors");
        let run = |more: &[&str]| {
            let own = ["run", policy.to_str().unwrap(), "--endpoint", &pair.endpoint, "--velocity", "0.2,0,0"];
            let arguments: Vec<String> = own.iter().chain(more).map(ToString::to_string).collect();
            Process::start(&program(), &arguments).unwrap()
        };
        let (mut ends, endpoint) = (run(&[]), pair.endpoint.clone());
        pair.wait_for("run", Duration::from_secs(20)).unwrap();
        twinstep_client::stop_robot(&endpoint, None, None).unwrap();
        assert_eq!(ends.exit_code(Duration::from_secs(20)), Some(1), "it ends with the fault");
        pair.insist("arm").unwrap();
        pair.insist("stand").unwrap();
        pair.wait_for("ready", Duration::from_secs(20)).unwrap();
        let own = ["run", policy.to_str().unwrap(), "--endpoint", &endpoint, "--velocity", "0.2,0,0", "--go-on"];
        let _waits = Process::start(&program(), &own.map(str::to_owned)).unwrap();
        std::thread::sleep(Duration::from_secs(3));
        assert!(pair.state().starts_with("ready"), "nobody has let it act: {}", pair.state());
        pair.insist("go").unwrap();
        pair.wait_for("run", Duration::from_secs(10)).unwrap();
    });
}

#[test]
fn line_that_is_no_text_is_an_error_and_the_next_stop_is_executed() {
    let mut pair = pair(&[]);
    pair.wait_for("observe", Duration::from_mins(1)).unwrap();
    pair.robot.write(b"\xe4\xff\n").unwrap();
    assert!(pair.operator("status").unwrap().starts_with("error"), "the answer to the first line");
    assert_eq!(pair.operator("stop").unwrap(), "ok stop");
}

#[test]
fn robot_and_process_go_on_after_they_were_suspended() {
    let mut pair = standing(&[]);
    for _ in 0..3 {
        pair.fake.freeze().unwrap();
        std::thread::sleep(Duration::from_millis(30));
        pair.fake.thaw().unwrap();
        std::thread::sleep(Duration::from_millis(100));
        pair.robot.freeze().unwrap();
        std::thread::sleep(Duration::from_millis(30));
        pair.robot.thaw().unwrap();
        std::thread::sleep(Duration::from_millis(100));
    }
    // It stands, or was damped because the pauses were too long: commands are sent in either case.
    let accepted = |pair: &mut RobotPair| pair.ask("statistics").unwrap()["accepted"].as_u64().unwrap();
    let before = accepted(&mut pair);
    std::thread::sleep(Duration::from_secs(1));
    let after = accepted(&mut pair);
    assert!(after > before + 50, "{before} commands, then {after}; {}", pair.state());
}

#[test]
fn interrupted_robot_is_damped_before_its_commands_cease() {
    let mut pair = standing(&[]);
    pair.robot.interrupt().unwrap();
    assert_eq!(pair.robot.exit_code(Duration::from_secs(30)), Some(130));
    let pose = pair.ask("pose").unwrap();
    assert!(pose["position"][2].as_f64().unwrap() < 0.2, "it lies: {pose}");
}

#[test]
fn run_that_waits_for_the_operator_ends_with_the_first_interrupt() {
    test_in_real_time(|| {
        let pair = pair(&[]);
        let policy = root().join("data/policies/walk.safetensors");
        let arguments = ["run", policy.to_str().unwrap(), "--endpoint", &pair.endpoint];
        let mut run = Process::start(&program(), &arguments.map(str::to_owned)).unwrap();
        std::thread::sleep(Duration::from_secs(2));
        run.interrupt().unwrap();
        assert_eq!(run.exit_code(Duration::from_secs(30)), Some(130));
    });
}

#[test]
fn python_client_that_waits_for_the_operator_ends_with_an_interrupt() {
    let Some(python) = python(&crate::python::target()).unwrap() else { return };
    let pair = pair(&[]);
    let script = format!(
        "import gymnasium, twinstep\nenv = gymnasium.make('twinstep/Go2-Walk-v0', endpoint='{}')\ntry:\n    env.reset()\nfinally:\n    env.close()",
        pair.endpoint
    );
    let mut agent = interruptible(&python)
        .args(["-c", &script])
        .env("PYTHONPATH", root().join("clients/python/src"))
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = std::io::BufRead::lines(std::io::BufReader::new(agent.stderr.take().unwrap()));
    assert!(lines.any(|line| line.unwrap().contains("the robot is not ready")), "it says what it waits for");
    assert!(Command::new("kill").args(["-INT", &agent.id().to_string()]).status().unwrap().success());
    let since = Instant::now();
    while agent.try_wait().unwrap().is_none() {
        if since.elapsed() > Duration::from_secs(30) {
            agent.kill().unwrap();
            panic!("it does not end");
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn robot_does_not_start_where_nobody_would_find_its_stop_channel() {
    // A pair of ports of which the second one is taken.
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let (next, domain) = (taken.local_addr().unwrap().port(), next_domain().to_string());
    let endpoint = format!("tcp/127.0.0.1:{}", next - 1);
    let own = ["robot", "--interface", "127.0.0.1", "--domain", &domain, "--listen", &endpoint];
    let robot = Command::new(program()).args(own).stdin(Stdio::null()).output().unwrap();
    let error = String::from_utf8_lossy(&robot.stderr);
    assert!(!robot.status.success() && error.contains(&format!("port {next}")), "{error}");
}
