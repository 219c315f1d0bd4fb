//! Files of transport.
use super::*;

#[test]
fn a_file_replays_as_the_record_did() {
    for transport in transports() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        transport.save(file.path()).expect("saves");
        let loaded = Transport::load(file.path()).expect("loads");
        assert_eq!(loaded.header(), transport.header());
        let light = random_vectors(512, 1);
        let y = random_vectors(144, 2);
        assert_eq!(loaded.foreground(&light), transport.foreground(&light));
        assert_eq!(loaded.shadow(&light), transport.shadow(&light));
        assert_eq!(loaded.foreground_vjp(&y), transport.foreground_vjp(&y));
        assert_eq!(loaded.coverage(), transport.coverage());
        assert_eq!(
            loaded.effective_sample_size(&light),
            transport.effective_sample_size(&light)
        );
        assert_eq!(
            loaded.light_sample_size(&light),
            transport.light_sample_size(&light)
        );
    }
}

/// Saves, lets `damage` change the bytes, and returns what loading says.
fn damaged(damage: impl FnOnce(&mut Vec<u8>)) -> Result<Transport, RenderError> {
    let transport = record(&knot(glossy(), ground()), &small(lambertian(1)));
    let file = tempfile::NamedTempFile::new().expect("a file");
    transport.save(file.path()).expect("saves");
    let mut bytes = std::fs::read(file.path()).expect("reads");
    damage(&mut bytes);
    std::fs::write(file.path(), bytes).expect("writes");
    Transport::load(file.path())
}

/// Where the bytes of tensor `name` begin.
fn tensor_start(bytes: &[u8], name: &str) -> usize {
    let header = u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize;
    let json: serde_json::Value = serde_json::from_slice(&bytes[8..8 + header]).expect("JSON");
    8 + header + json[name]["data_offsets"][0].as_u64().expect("a number") as usize
}

fn replace(bytes: &mut [u8], from: &str, to: &str) {
    assert_eq!(from.len(), to.len());
    let at = bytes
        .windows(from.len())
        .position(|w| w == from.as_bytes())
        .expect("is there");
    bytes[at..at + from.len()].copy_from_slice(to.as_bytes());
}

#[test]
fn damaged_files_are_refused_by_what_is_wrong() {
    assert!(damaged(|_| ()).is_ok());
    type Damage = fn(&mut Vec<u8>);
    let cases: [(Damage, &str); 10] = [
        (|b| b.clear(), "is not safetensors"),
        (|b| b.truncate(b.len() - 1), "is not safetensors"),
        (|b| b[..8].fill(0xff), "is not safetensors"),
        (
            |b| replace(b, "dipir_transport_3", "dipir_transport_9"),
            "has no metadata \"dipir_transport_3\"",
        ),
        (
            |b| replace(b, "\\\"size\\\":[12,12]", "\\\"size\\\":[12,99]"),
            "instead of",
        ),
        (
            |b| {
                replace(
                    b,
                    "\\\"environment\\\":[32,16]",
                    "\\\"environment\\\":[32,00]",
                )
            },
            "damaged header",
        ),
        (
            |b| {
                let at = tensor_start(b, "object.offsets");
                b[at..at + 4].fill(0xff);
            },
            "has decreasing \"object.offsets\"",
        ),
        (
            |b| {
                let at = tensor_start(b, "object.order");
                b.copy_within(at..at + 2, at + 2);
            },
            "has pixels twice in \"object.order\"",
        ),
        (
            |b| {
                // The texel of the first entry.
                let at = tensor_start(b, "shadow.blocked.entries") + 2;
                b[at..at + 2].fill(0xff);
            },
            "for texel 65535 of 512",
        ),
        (
            |b| {
                let at = tensor_start(b, "coverage");
                b[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
            },
            "has NaN at index 0 of \"coverage\"",
        ),
    ];
    for (damage, expected) in cases {
        let error = damaged(damage).map(|_| ()).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
        assert!(
            error.ends_with("record it again with dipir-scene"),
            "{error}"
        );
    }
    let missing = Transport::load("/nonexistent/transport.safetensors").map(|_| ());
    assert!(
        missing
            .expect_err("is missing")
            .to_string()
            .contains("cannot be opened")
    );
}
