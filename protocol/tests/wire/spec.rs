//! `SPEC.md` names everything that the wire has.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use serde::de::IgnoredAny;
use twinstep_model::AutoresetMode;
use twinstep_protocol::keys::{self, EnvMethod};
use twinstep_protocol::{ErrorCode, PROTOCOL};

use crate::golden;

const SPEC: &str = include_str!("../../SPEC.md");

#[derive(Deserialize)]
#[serde(untagged)]
enum Value {
    Map(BTreeMap<String, Value>),
    List(Vec<Value>),
    Other(IgnoredAny),
}

fn collect_fields(value: Value, fields: &mut BTreeSet<String>) {
    match value {
        Value::Map(map) => {
            for (name, value) in map {
                fields.insert(name);
                collect_fields(value, fields);
            }
        }
        Value::List(values) => values.into_iter().for_each(|value| collect_fields(value, fields)),
        Value::Other(_) => {}
    }
}

/// The text under `title`, up to the next title.
fn section(title: &str) -> &'static str {
    let start = SPEC.find(title).unwrap_or_else(|| panic!("SPEC.md has no `{title}`"));
    let rest = &SPEC[start + title.len()..];
    &rest[..rest.find("\n#").unwrap_or(rest.len())]
}

/// First cells of the tables in `text`, without backticks.
fn first_cells(text: &str) -> BTreeSet<String> {
    let cells = text.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next());
    cells.map(str::to_owned).collect()
}

fn golden_map(name: &str) -> BTreeMap<String, Value> {
    rmp_serde::from_slice(golden::read(name)).expect("golden bytes are a map")
}

#[test]
fn tables_have_exactly_the_fields_of_the_messages() {
    // Optional fields are in some of the files.
    let tables: [(&str, &[&str]); 17] = [
        ("### hello request", &["hello_request"]),
        ("### hello reply", &["hello_reply_real_time"]),
        ("### lease request", &["lease_request_critic"]),
        ("### lease reply", &["lease_reply"]),
        ("### reset request", &["reset_request"]),
        ("### reset reply", &["reset_reply_critic", "reset_reply_real_time"]),
        ("### step request", &["step_request_command", "step_request_gait", "step_request_real_time"]),
        ("### step reply", &["step_reply_critic", "step_reply_real_time"]),
        ("### rollout request", &["rollout_request", "rollout_request_held"]),
        ("### rollout reply", &["rollout_reply_critic"]),
        ("### stop request", &["stop_request"]),
        ("### stop reply", &["stop_reply"]),
        ("### close request", &["close_request"]),
        ("### close reply", &["close_reply"]),
        ("### render request", &["render_request"]),
        ("### render reply", &["render_reply"]),
        ("### error reply", &["error"]),
    ];
    for (title, names) in tables {
        let fields: BTreeSet<String> = names.iter().flat_map(|name| golden_map(name).into_keys()).collect();
        assert_eq!(first_cells(section(title)), fields, "{title}");
    }
    let Some(Value::Map(real_time)) = golden_map("hello_reply_real_time").remove("real_time") else { panic!("a map") };
    assert_eq!(first_cells(section("### real time")), real_time.into_keys().collect());
    let Some(Value::Map(policy)) = golden_map("rollout_request").remove("policy") else { panic!("a map") };
    assert_eq!(first_cells(section("### rollout policy")), policy.into_keys().collect());
    let spec = |name: &str| match golden_map(name).remove("spec") {
        Some(Value::Map(spec)) => spec,
        _ => panic!("`spec` is a map"),
    };
    let fields = spec("hello_reply").into_keys().chain(spec("hello_reply_joint_gains").into_keys());
    assert_eq!(first_cells(section("### spec")), fields.collect());
    let Some(Value::List(shapes)) = golden_map("render_reply").remove("shapes") else { panic!("`shapes` is a list") };
    let maps = shapes.into_iter().map(|shape| match shape {
        Value::Map(shape) => shape,
        _ => panic!("a shape is a map"),
    });
    // Not every shape has a colour and a mesh.
    let keys = maps.flat_map(BTreeMap::into_keys).collect();
    assert_eq!(first_cells(section("### shape\n")), keys);
    assert_eq!(first_cells(section("### mesh\n")), ["faces", "points"].map(str::to_owned).into());
}

#[test]
fn tables_have_exactly_the_fields_of_the_ground() {
    let Some(Value::Map(mut ground)) = golden_map("render_reply_rough").remove("ground") else { panic!("a map") };
    assert_eq!(first_cells(section("### ground\n")), ground.keys().cloned().collect());
    let Some(Value::Map(field)) = ground.remove("height_field") else { panic!("a map") };
    assert_eq!(first_cells(section("### height field\n")), field.into_keys().collect());
}

#[test]
fn every_field_at_any_depth_is_named() {
    let mut fields = BTreeSet::new();
    for name in golden::NAMES {
        collect_fields(Value::Map(golden_map(name)), &mut fields);
    }
    for field in fields {
        assert!(SPEC.contains(&format!("`{field}`")), "SPEC.md says nothing of the field `{field}`");
    }
}

#[test]
fn table_of_errors_has_exactly_the_codes() {
    let codes = ErrorCode::ALL.map(|code| {
        let quoted = rmp_serde::to_vec_named(&code).expect("a code is a string");
        rmp_serde::from_slice::<String>(&quoted).expect("a code is a string")
    });
    assert_eq!(first_cells(section("## Error codes")), codes.into());
}

#[test]
fn every_verb_key_and_mode_is_named() {
    let verbs = EnvMethod::ALL.map(|verb| keys::env("<server_id>", "<lease>", verb));
    let places = [keys::hello("<server_id>"), keys::lease("<server_id>"), keys::LIVE_SERVERS.to_owned()];
    let views = [keys::scene("<server_id>"), keys::frame("<server_id>")];
    let tokens = [keys::live_server("<server_id>", "<name>"), keys::live_client("<server_id>", "<client>")];
    for key in verbs.iter().chain(&places).chain(&views).chain(&tokens) {
        assert!(SPEC.contains(&format!("`{key}`")), "SPEC.md says nothing of the key `{key}`");
    }
    for mode in [AutoresetMode::NextStep, AutoresetMode::SameStep, AutoresetMode::Disabled] {
        assert!(SPEC.contains(&format!("`\"{mode:?}\"`")), "SPEC.md says nothing of the mode {mode:?}");
    }
    assert!(SPEC.contains(&format!("`protocol` = {PROTOCOL}")));
}
