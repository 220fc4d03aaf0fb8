//! Every sequence number is executed once, and a rejected request is never executed. Checked with the task `counter`.

use std::sync::Arc;

use twinstep_envs::TaskConfig;
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::message::{CloseRequest, LeaseReply, ResetRequest};
use twinstep_protocol::tensor::as_bytes;
use twinstep_protocol::{ErrorCode, PROTOCOL, encode, keys};

use crate::raw_client::{RawClient, only_reply, reset_bytes, resets_in, step_bytes, step_with, steps_in};
use crate::remote::{FailingEnvFactory, config, start, start_with};

/// Runs `test` with a client and its lease of two counters, reset with sequence number 1.
fn with_counters(test: impl FnOnce(&RawClient, &LeaseReply)) {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(2);
    client.reset(&lease, 1).unwrap();
    test(&client, &lease);
    server.shutdown();
}

#[test]
fn request_sent_three_times_is_executed_once_with_equal_replies() {
    with_counters(|client, lease| {
        let step = client.step(lease, 2).unwrap();
        assert_eq!(steps_in(&step), 1.0);
        assert_eq!([client.step(lease, 2).unwrap(), client.step(lease, 2).unwrap()], [step.clone(), step]);
        assert_eq!(steps_in(&client.step(lease, 3).unwrap()), 2.0);
        let reset = client.reset(lease, 4).unwrap();
        assert_eq!(resets_in(&reset), 2.0);
        assert_eq!([client.reset(lease, 4).unwrap(), client.reset(lease, 4).unwrap()], [reset.clone(), reset]);
        assert_eq!(resets_in(&client.reset(lease, 5).unwrap()), 3.0);
    });
}

#[test]
fn same_number_with_another_request_is_rejected_without_effect() {
    with_counters(|client, lease| {
        let step = |action: f32| client.ask_env(lease, EnvMethod::Step, &step_with(lease, 2, &[action; 24]));
        let first = step(0.2).unwrap();
        assert_eq!(step(0.7).unwrap_err().code, ErrorCode::StaleSequence, "its transition would be that of 0.2");
        assert_eq!(step(0.2).unwrap(), first);
        assert_eq!(steps_in(&client.step(lease, 3).unwrap()), 2.0);
    });
}

#[test]
fn request_sent_again_while_it_is_in_progress_is_executed_once() {
    with_counters(|client, lease| {
        let key = keys::env(&client.sid, &lease.lease, EnvMethod::Step);
        for seq in 2..50 {
            let sent: Vec<_> = (0..3).map(|_| client.send(&key, &step_bytes(lease, seq))).collect();
            let replies: Vec<_> = sent.iter().map(|replies| only_reply(replies, &key).unwrap()).collect();
            assert_eq!(steps_in(&replies[0]), (seq - 1) as f32);
            assert!(replies.iter().all(|reply| *reply == replies[0]));
        }
    });
}

#[test]
fn repeated_close_returns_the_same_reply_or_finds_no_lease() {
    with_counters(|client, lease| {
        let closed = client.close(lease, 2).unwrap();
        match client.close(lease, 2) {
            Ok(again) => assert_eq!(again, closed),
            Err(error) => assert_eq!(error.code, ErrorCode::LeaseLost),
        }
        assert_eq!(client.hello().free_envs, 64);
    });
}

#[test]
fn sequence_numbers_and_epochs_out_of_order_are_rejected_without_effect() {
    with_counters(|client, lease| {
        client.step(lease, 2).unwrap();
        let other_epoch = |epoch| LeaseReply { epoch, ..lease.clone() };
        for (epoch, seq, expected) in [
            (1, 4, ErrorCode::SequenceGap),
            (1, u64::MAX, ErrorCode::SequenceGap),
            (1, 1, ErrorCode::StaleSequence),
            (1, 0, ErrorCode::StaleSequence),
            (0, 3, ErrorCode::StaleEpoch),
            (2, 3, ErrorCode::StaleEpoch),
            (u64::MAX, 3, ErrorCode::StaleEpoch),
        ] {
            let error = client.step(&other_epoch(epoch), seq).unwrap_err();
            assert_eq!(error.code, expected, "epoch {epoch}, seq {seq}");
        }
        assert_eq!(client.reset(lease, 2).unwrap_err().code, ErrorCode::StaleSequence, "sequence number 2 was a step");
        assert_eq!(steps_in(&client.step(lease, 3).unwrap()), 2.0);
    });
}

#[test]
fn invalid_arrays_are_rejected_by_name_without_effect() {
    with_counters(|client, lease| {
        let step = |actions: &[f32]| client.ask_env(lease, EnvMethod::Step, &step_with(lease, 2, actions)).unwrap_err();
        for length in [0, 12, 23, 25, 48] {
            let error = step(&vec![0.0; length]);
            assert_eq!((error.code, error.field.as_str()), (ErrorCode::BadShape, "actions"), "{length} actions");
        }
        // The server hosts 64 environments, this lease has two of them.
        for length in [64 * 12, 900_000] {
            assert_eq!(step(&vec![0.0; length]).code, ErrorCode::TooLarge, "{length} actions");
        }
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut actions = [0.0; 24];
            actions[23] = value;
            assert_eq!(step(&actions).code, ErrorCode::NotFinite, "{value}");
        }
        let (seeds, mask) = ([0u64; 3], [1u8; 3]);
        let reset = ResetRequest { protocol: PROTOCOL, epoch: 1, seq: 2, seeds: None, mask: None };
        for (field, request) in [
            ("seeds", ResetRequest { seeds: Some(as_bytes(&seeds)), ..reset.clone() }),
            ("seeds", ResetRequest { seeds: Some(&[0; 15]), ..reset.clone() }),
            ("mask", ResetRequest { mask: Some(&mask), ..reset.clone() }),
            ("mask", ResetRequest { mask: Some(&[]), ..reset }),
        ] {
            let error = client.ask_env(lease, EnvMethod::Reset, &encode(&request)).unwrap_err();
            assert_eq!((error.code, error.field.as_str()), (ErrorCode::BadShape, field));
        }
        assert_eq!(steps_in(&client.step(lease, 2).unwrap()), 1.0, "the sequence number was not consumed");
    });
}

#[test]
fn other_protocol_version_is_rejected_at_every_key_except_hello() {
    with_counters(|client, lease| {
        for key in [
            keys::lease(&client.sid),
            keys::env(&client.sid, &lease.lease, EnvMethod::Reset),
            keys::env(&client.sid, &lease.lease, EnvMethod::Step),
            keys::env(&client.sid, &lease.lease, EnvMethod::Close),
            keys::env(&client.sid, &lease.lease, EnvMethod::Render),
        ] {
            // Once with all fields of the message, once with no field of version 1 except `protocol`.
            let close = encode(&CloseRequest { protocol: 2, epoch: 1, seq: 2 });
            for payload in [close.as_slice(), b"\x82\xa8protocol\x02\xa3new\xc0"] {
                assert_eq!(client.ask(&key, payload).unwrap_err().code, ErrorCode::Version, "{key}");
            }
        }
        assert!(client.ask(&keys::hello(&client.sid), b"\x81\xa8protocol\x02").is_ok());
        assert_eq!(steps_in(&client.step(lease, 2).unwrap()), 1.0);
    });
}

#[test]
fn unknown_lease_is_distinguished_from_unknown_keys() {
    with_counters(|client, lease| {
        let unknown = LeaseReply { lease: "0123456789abcdef".to_owned(), ..lease.clone() };
        assert_eq!(client.step(&unknown, 2).unwrap_err().code, ErrorCode::LeaseLost);
        for rest in ["", "/env", "/lease/x", "/*", "/**"] {
            let key = format!("twinstep/{}{rest}", client.sid);
            assert_eq!(client.ask(&key, b"").unwrap_err().code, ErrorCode::UnknownKey, "{key}");
        }
        let key = format!("twinstep/{}/env/{}/jump", client.sid, lease.lease);
        assert_eq!(client.ask(&key, &step_bytes(lease, 2)).unwrap_err().code, ErrorCode::UnknownKey);
        assert_eq!(steps_in(&client.step(lease, 2).unwrap()), 1.0);
    });
}

#[test]
fn lease_whose_environments_panicked_can_be_closed_or_replaced_by_a_new_one() {
    let (server, endpoint) = start_with(&config(TaskConfig::Counter), Arc::new(FailingEnvFactory));
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let panicked = || {
        let lease = client.lease(64);
        client.reset(&lease, 1).unwrap();
        (2..4).for_each(|seq| drop(client.step(&lease, seq).unwrap()));
        assert_eq!(client.step(&lease, 4).unwrap_err().code, ErrorCode::LeaseLost);
        lease
    };
    let first = panicked();
    client.close(&first, 5).unwrap();
    panicked();
    assert_eq!(client.ask_lease(&client.lease_request(64)).unwrap_err().code, ErrorCode::LeaseLost);
    let third = client.lease(64);
    client.ask_env(&third, EnvMethod::Reset, &reset_bytes(&third, 1)).unwrap();
    server.shutdown();
}
