//! The server as a browser meets it.
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use dipir_cli::session::Session;
use dipir_placing::desk::Desk;
use dipir_placing::server::Place;
use serde_json::{Value, json};
use tempfile::TempDir;

mod project;
use project::{TEXT, open, project};

/// More than any answer takes on a slow machine.
const PATIENCE: Duration = Duration::from_secs(120);

struct Running {
    folder: TempDir,
    authority: String,
    token: String,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Answer {
    status: u16,
    head: String,
    body: Vec<u8>,
}

impl Answer {
    fn json(&self) -> Value {
        assert_eq!(self.status, 200, "{}", String::from_utf8_lossy(&self.body));
        serde_json::from_slice(&self.body).unwrap()
    }

    fn header(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines();
        lines.find_map(|l| {
            let (field, value) = l.split_once(": ")?;
            field.eq_ignore_ascii_case(name).then_some(value)
        })
    }
}

impl Running {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let session = project(folder.path(), &[]);
        Self::of(folder, session)
    }

    fn of(folder: TempDir, session: Session) -> Self {
        let desk = Desk::open(session).unwrap();
        let place = Place::listen(desk, 0).unwrap();
        let address = place.address();
        let parts: Vec<&str> = address.split('/').collect();
        let stop = Arc::new(AtomicBool::new(false));
        Self {
            authority: parts[2].into(),
            token: parts[3].into(),
            thread: Some({
                let stop = stop.clone();
                thread::spawn(move || place.serve(&stop).unwrap())
            }),
            stop,
            folder,
        }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A connection that fails instead of waiting for ever.
    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.authority).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.set_write_timeout(Some(PATIENCE)).unwrap();
        stream
    }

    /// Sends a request whose head is given, and reads the answer.
    fn send(&self, head: &str, body: &[u8]) -> Answer {
        let mut stream = self.connect();
        let head = format!("{head}\r\nConnection: close\r\n\r\n");
        stream.write_all(head.as_bytes()).unwrap();
        stream.write_all(body).unwrap();
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).unwrap();
        let end = bytes.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
        Answer {
            status: head.split(' ').nth(1).unwrap().parse().unwrap(),
            head,
            body: bytes[end + 4..].to_vec(),
        }
    }

    fn get(&self, path: &str) -> Answer {
        let (token, host) = (&self.token, &self.authority);
        self.send(
            &format!("GET /{token}/{path} HTTP/1.1\r\nHost: {host}"),
            b"",
        )
    }

    fn post_bytes(&self, path: &str, body: &[u8]) -> Answer {
        let (token, host) = (&self.token, &self.authority);
        let head = format!(
            "POST /{token}/{path} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n\
             Content-Length: {}",
            body.len()
        );
        self.send(&head, body)
    }

    fn post(&self, path: &str, body: &Value) -> Answer {
        self.post_bytes(path, body.to_string().as_bytes())
    }
}

fn moved_to(x: f64, y: f64) -> Value {
    json!({"objects": [{"of": 0, "at": [x, y]}]})
}

#[test]
fn the_page_and_all_its_files_are_served_and_may_load_nothing_else() {
    let place = Running::new();
    let page = place.get("");
    assert_eq!(page.status, 200);
    let policy = page.header("Content-Security-Policy").unwrap();
    assert!(policy.starts_with("default-src 'none'"), "{policy}");
    let text = String::from_utf8(page.body).unwrap();
    assert!(!text.contains("http:") && !text.contains("https:"));
    for name in [
        "main.js",
        "style.css",
        "api.js",
        "tools.js",
        "photo.png",
        "state",
    ] {
        assert_eq!(place.get(name).status, 200, "{name}");
    }
}

#[test]
fn what_is_not_the_page_is_refused() {
    let place = Running::new();
    let (token, host) = (&place.token, &place.authority);
    let secret = fs::read_to_string(place.file("pipeline.toml")).unwrap();
    for (head, status) in [
        (format!("GET / HTTP/1.1\r\nHost: {host}"), 403),
        (
            format!("GET /{}/ HTTP/1.1\r\nHost: {host}", "0".repeat(32)),
            403,
        ),
        (format!("GET /{token}/ HTTP/1.1\r\nHost: evil.example"), 403),
        (
            format!("GET /{token}/state HTTP/1.1\r\nHost: {host}\r\nOrigin: http://evil.example"),
            403,
        ),
        (
            format!("GET /{token}/../pipeline.toml HTTP/1.1\r\nHost: {host}"),
            404,
        ),
        (
            format!("GET /{token}/%2e%2e/pipeline.toml HTTP/1.1\r\nHost: {host}"),
            404,
        ),
        (
            format!("GET /{token}//etc/passwd HTTP/1.1\r\nHost: {host}"),
            404,
        ),
        (format!("GET /{token}/save HTTP/1.1\r\nHost: {host}"), 405),
        (
            format!("DELETE /{token}/save HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}"),
            405,
        ),
        (
            format!("POST /{token}/save HTTP/1.1\r\nHost: {host}\r\nContent-Length: 0"),
            403,
        ),
    ] {
        let answer = place.send(&head, b"");
        assert_eq!(answer.status, status, "{head}");
        assert!(!String::from_utf8_lossy(&answer.body).contains("[scene]"));
    }
    assert_eq!(
        fs::read_to_string(place.file("pipeline.toml")).unwrap(),
        secret
    );
}

#[test]
fn a_body_of_100_megabytes_is_refused_before_it_is_sent() {
    let place = Running::new();
    let (token, host) = (&place.token, &place.authority);
    for route in ["save", "mask", "draft"] {
        let mut stream = place.connect();
        let head = format!(
            "POST /{token}/{route} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n\
             Content-Length: 104857600\r\n\r\n"
        );
        stream.write_all(head.as_bytes()).unwrap();
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).unwrap();
        assert_eq!(&answer, b"HTTP/1.1 413");
    }
    // Others are served meanwhile.
    assert_eq!(place.get("state").status, 200);
    // A mask has a byte a pixel, no more and no less.
    assert_eq!(place.post_bytes("mask", &[0; 60_000]).status, 200);
    assert_eq!(place.post_bytes("mask", &[0; 60_001]).status, 413);
    assert_eq!(place.post_bytes("mask", &[0; 59_999]).status, 422);
}

#[test]
fn more_connections_than_a_browser_needs_are_closed_until_others_end() {
    let place = Running::new();
    let silent: Vec<TcpStream> = (0..200).map(|_| place.connect()).collect();
    // No byte was sent to it: it is closed without a word.
    assert_eq!((&silent[199]).read(&mut [0]).unwrap(), 0);
    drop(silent);
    let (token, host) = (&place.token, &place.authority);
    let head = format!("GET /{token}/mask.bin HTTP/1.1\r\nHost: {host}\r\n\r\n");
    let begins = || {
        let mut stream = place.connect();
        let sent = stream.write_all(head.as_bytes());
        let mut answer = [0; 12];
        sent.and_then(|()| stream.read_exact(&mut answer))
            .is_ok_and(|()| answer.ends_with(b"200"))
    };
    let begin = Instant::now();
    while !begins() {
        assert!(begin.elapsed() < PATIENCE);
    }
}

#[test]
fn connections_that_stay_open_keep_nobody_waiting() {
    let place = Running::new();
    let silent: Vec<TcpStream> = (0..20).map(|_| place.connect()).collect();
    let (token, host) = (&place.token, &place.authority);
    // As browsers do: further requests on a connection that is kept.
    let mut kept: Vec<TcpStream> = (0..6).map(|_| place.connect()).collect();
    for _ in 0..3 {
        for stream in &mut kept {
            let head = format!("GET /{token}/mask.bin HTTP/1.1\r\nHost: {host}\r\n\r\n");
            stream.write_all(head.as_bytes()).unwrap();
        }
        for stream in &mut kept {
            let mut head = Vec::new();
            while !head.ends_with(b"\r\n\r\n") {
                let mut byte = [0];
                stream.read_exact(&mut byte).unwrap();
                head.extend(byte);
            }
            assert!(head.starts_with(b"HTTP/1.1 200"));
        }
    }
    assert_eq!(place.get("state").status, 200);
    drop(silent);
}

#[test]
fn saving_keeps_comments_and_order() {
    let place = Running::new();
    let mut edit = moved_to(200.0, 120.0);
    edit["turn"] = json!({"pitch_deg": -12.5, "roll_deg": 0.0, "fov_deg": 45.0});
    edit["exposure_ev"] = json!(0.5);
    let saved = place.post("save", &edit).json();
    assert_eq!(saved["written"].as_array().unwrap().len(), 1);
    let text = fs::read_to_string(place.file("pipeline.toml")).unwrap();
    let expected = TEXT
        .replace("[150.0, 150.0] #", "[200.0, 120.0] #")
        .replace("pitch_deg = -10.0 #", "pitch_deg = -12.5 #")
        .replace("fov_deg = 50.0\n", "fov_deg = 45.0\nroll_deg = 0.0\n")
        + "\n[composite]\nexposure_ev = 0.5\n";
    assert_eq!(text, expected);
    // Nothing but the file is left in the folder.
    assert_eq!(fs::read_dir(place.folder.path()).unwrap().count(), 3);
}

#[test]
fn what_cannot_be_is_not_saved() {
    let place = Running::new();
    for edit in [
        moved_to(150.0, 10.0),
        moved_to(1e300, 10.0),
        json!({"objects": []}),
        json!({"objects": [{"of": 7}]}),
        json!({"objects": [{"of": 0, "size": -1.0}]}),
        json!({"objects": [{"of": 0}], "unknown": 1}),
        json!({"objects": [{"of": u64::MAX}]}),
        json!({"objects": [{"of": 0}], "shadow": {"foot": [9.0, 150.0], "tip": [9.0, 150.0]}}),
        json!({"objects": [{"of": 0}], "shadow": {"foot": [9.0, 150.0], "tip": [30.0, 140.0], "height_m": -1.0}}),
        json!({"objects": [{"of": 0}], "sun": {"azimuth_deg": 1e300, "elevation_deg": 30.0}}),
    ] {
        assert_eq!(place.post("save", &edit).status, 422, "{edit}");
    }
    // Another program's changes are not written over.
    let other = TEXT.replace("mine", "yours");
    fs::write(place.file("pipeline.toml"), &other).unwrap();
    let answer = place.post("save", &moved_to(200.0, 150.0));
    assert_eq!(answer.status, 422);
    assert!(String::from_utf8_lossy(&answer.body).contains("another program"));
    assert_eq!(
        fs::read_to_string(place.file("pipeline.toml")).unwrap(),
        other
    );
}

#[test]
fn an_edit_of_a_text_that_was_saved_over_is_refused() {
    let place = Running::new();
    let revision = || place.get("state").json()["edit"]["revision"].clone();
    // Two tabs read the file.
    let first = revision();
    let larger = json!({"objects": [{"of": 0, "size": 2.0}], "revision": first});
    let moved = json!({"objects": [{"of": 0, "at": [200.0, 150.0]}], "revision": first});
    let next = place.post("save", &larger).json()["state"]["edit"]["revision"].clone();
    let saved = fs::read_to_string(place.file("pipeline.toml")).unwrap();
    assert!(saved.contains("scale = 2.0"), "{saved}");
    for edit in [&moved, &larger] {
        let drawn = place.post("view", &json!({"edit": edit, "grid": false}));
        let answer = place.post("save", edit);
        for answer in [drawn, answer] {
            let told = String::from_utf8_lossy(&answer.body).into_owned();
            assert!(answer.status == 422 && told.contains("reload"), "{told}");
        }
        let now = fs::read_to_string(place.file("pipeline.toml")).unwrap();
        assert_eq!(now, saved);
    }
    // A page that is loaded again, and one that saved, go on.
    assert_eq!(revision(), next);
    let moved = json!({"objects": [{"of": 0, "at": [200.0, 150.0]}], "revision": next});
    let same = json!({"objects": [{"of": 0}], "revision": next});
    assert_eq!(place.post("save", &same).status, 200);
    // What changed nothing holds nobody up.
    assert_eq!(place.post("save", &moved).status, 200);
    let now = fs::read_to_string(place.file("pipeline.toml")).unwrap();
    assert!(
        now.contains("scale = 2.0") && now.contains("[200.0, 150.0]"),
        "{now}"
    );
}

#[test]
fn a_light_that_a_run_refuses_is_not_saved() {
    let folder = tempfile::tempdir().unwrap();
    project(folder.path(), &[]);
    let text = TEXT.split("[light]").next().unwrap();
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    let session = open(folder.path(), &[]);
    let place = Running::of(folder, session);
    let saved = |foot: [f64; 2]| {
        let shadow = json!({"foot": foot, "tip": [60.0, 150.0]});
        let edit = json!({"objects": [{"of": 0}], "shadow": shadow});
        place.post("save", &edit)
    };
    // No ground is seen above the horizon.
    let answer = saved([20.0, 5.0]);
    let told = String::from_utf8_lossy(&answer.body).into_owned();
    assert!(
        answer.status == 422 && told.contains("light.shadow"),
        "{told}"
    );
    let now = || fs::read_to_string(place.file("pipeline.toml")).unwrap();
    assert_eq!(now(), text);
    assert_eq!(saved([20.0, 170.0]).status, 200);
    assert!(now().contains("foot = [20.0, 170.0]"));
}

#[test]
fn a_mask_replaces_no_file_of_anothers() {
    let place = Running::new();
    assert_eq!(place.post_bytes("mask", &[255; 60_000]).status, 200);
    let edit = json!({"objects": [{"of": 0}], "mask": true});
    fs::write(place.file("holdout.png"), "mine").unwrap();
    assert_eq!(place.post("save", &edit).status, 422);
    assert_eq!(
        fs::read_to_string(place.file("holdout.png")).unwrap(),
        "mine"
    );
    assert_eq!(
        fs::read_to_string(place.file("pipeline.toml")).unwrap(),
        TEXT
    );
    fs::remove_file(place.file("holdout.png")).unwrap();
    let saved = place.post("save", &edit).json();
    let mut edit = edit;
    edit["revision"] = saved["state"]["edit"]["revision"].clone();
    place.post("save", &edit).json();
    let text = fs::read_to_string(place.file("pipeline.toml")).unwrap();
    assert!(text.contains("occluders = \"holdout.png\""), "{text}");
    let mask = dipir_imaging::file::read_mask(place.file("holdout.png")).unwrap();
    assert!(mask.pixels().iter().all(|&v| v == 1.0));
    // All is hidden: the objects change nothing.
    let hidden = place.post(
        "draft",
        &json!({"edit": {"objects": [{"of": 0}], "revision": edit["revision"]}, "samples": 1}),
    );
    assert_eq!(hidden.status, 204);
}

#[test]
fn the_draft_shows_the_object_where_the_projection_says() {
    let place = Running::new();
    let mut edit = moved_to(190.0, 140.0);
    // Brighter than the photograph, whatever the box is made of.
    edit["exposure_ev"] = json!(2.0);
    let view = place
        .post("view", &json!({"edit": edit, "grid": true}))
        .json();
    let object = &view["objects"][0];
    let contact = |k: usize| object["contact"][k].as_f64().unwrap();
    // Written to a tenth of a pixel.
    assert!(
        (contact(0) - 190.0).abs() < 0.1 && (contact(1) - 140.0).abs() < 0.1,
        "{object}"
    );
    assert!(!view["grid"].as_array().unwrap().is_empty());
    let draft = place.post("draft", &json!({"edit": edit, "samples": 4}));
    assert_eq!(draft.status, 200);
    assert!(draft.body.starts_with(b"\x89PNG"));
    let about: Value = serde_json::from_str(draft.header("X-Draft").unwrap()).unwrap();
    let shown: Vec<f64> = serde_json::from_value(about["place"].clone()).unwrap();
    let lines = object["lines"].as_array().unwrap().iter();
    let lines: Vec<Vec<f64>> = lines
        .filter(|l| l[0] == 3)
        .map(|l| serde_json::from_value(l.clone()).unwrap())
        .collect();
    let least = |k: usize| {
        lines
            .iter()
            .flat_map(|l| [l[k], l[k + 2]])
            .fold(f64::MAX, f64::min)
    };
    let most = |k: usize| {
        lines
            .iter()
            .flat_map(|l| [l[k], l[k + 2]])
            .fold(f64::MIN, f64::max)
    };
    // The top of the box is the top of what changed, to a pixel and its rounding; its shadow reaches
    // beyond the box elsewhere.
    assert!((shown[1] - least(2)).abs() <= 2.0, "{shown:?} {}", least(2));
    assert!(
        shown[0] <= least(1) + 2.0 && shown[2] >= most(1) - 2.0,
        "{shown:?}"
    );
    assert!(shown[3] >= most(2) - 2.0, "{shown:?}");
}

/// Mean difference of two pictures where both are, in steps of 8 bits.
fn apart(a: &Answer, b: &Answer) -> f64 {
    let read = |answer: &Answer| {
        assert_eq!(answer.status, 200);
        let about: Value = serde_json::from_str(answer.header("X-Draft").unwrap()).unwrap();
        let place: [u32; 4] = serde_json::from_value(about["place"].clone()).unwrap();
        let picture = image::load_from_memory(&answer.body).unwrap().to_rgb8();
        (place, picture)
    };
    let ((p, a), (q, b)) = (read(a), read(b));
    let span = |k: usize| p[k].max(q[k])..p[k + 2].min(q[k + 2]);
    let (mut sum, mut count) = (0.0, 0.0);
    for y in span(1) {
        for x in span(0) {
            let (c, d) = (
                a.get_pixel(x - p[0], y - p[1]),
                b.get_pixel(x - q[0], y - q[1]),
            );
            sum +=
                c.0.iter()
                    .zip(d.0)
                    .map(|(m, n)| f64::from(m.abs_diff(n)))
                    .sum::<f64>();
            count += 3.0;
        }
    }
    assert!(count > 3000.0, "{p:?} {q:?}");
    sum / count
}

#[test]
fn turning_the_sun_and_the_exposure_shows_what_a_draft_shows() {
    let folder = tempfile::tempdir().unwrap();
    let text = TEXT.replace("start = \"neutral\"", "sun = { share = 0.6 }");
    project(folder.path(), &[]);
    fs::write(folder.path().join("pipeline.toml"), text).unwrap();
    let session = open(folder.path(), &[]);
    let place = Running::of(folder, session);
    let lit = |azimuth: f64, elevation: f64, stops: f64| {
        json!({"objects": [{"of": 0, "at": [150.0, 140.0]}], "exposure_ev": stops,
            "sun": {"azimuth_deg": azimuth, "elevation_deg": elevation}})
    };
    let mut last: Option<Answer> = None;
    for (azimuth, elevation, stops) in [(60.0, 40.0, 0.0), (-50.0, 30.0, 0.0), (100.0, 55.0, 1.0)] {
        let edit = lit(azimuth, elevation, stops);
        let relit = place.post("relight", &json!({"edit": edit}));
        let draft = place.post("draft", &json!({"edit": edit, "samples": 32}));
        for answer in [&relit, &draft] {
            let about: Value = serde_json::from_str(answer.header("X-Draft").unwrap()).unwrap();
            let sun = |key: &str| about["light"]["sun"][key].as_f64().unwrap();
            assert!((sun("azimuth_deg") - azimuth).abs() < 0.1, "{about}");
            assert!((sun("elevation_deg") - elevation).abs() < 0.1, "{about}");
        }
        let same = apart(&relit, &draft);
        assert!(same < 4.0, "{azimuth}: {same}");
        if let Some(last) = &last {
            let other = apart(last, &draft);
            assert!(other > 2.0 * same, "{azimuth}: {same} {other}");
        }
        last = Some(relit);
    }
}

#[test]
fn a_light_that_is_given_is_said_not_to_follow_the_sun() {
    for (start, fixed) in [("neutral", true), ("estimated", false)] {
        let folder = tempfile::tempdir().unwrap();
        project(folder.path(), &[]);
        let text = TEXT.replace("neutral", start);
        fs::write(folder.path().join("pipeline.toml"), text).unwrap();
        let session = open(folder.path(), &[]);
        let place = Running::of(folder, session);
        let edit = moved_to(150.0, 140.0);
        let draft = place.post("draft", &json!({"edit": edit, "samples": 4}));
        let about: Value = serde_json::from_str(draft.header("X-Draft").unwrap()).unwrap();
        assert_eq!(about["light"]["fixed"], fixed, "{about}");
    }
}

#[test]
fn a_known_length_lifts_the_camera_and_lines_turn_it() {
    let place = Running::new();
    let edit = json!({"objects": [{"of": 0}]});
    let ends = [[100.0, 160.0], [200.0, 160.0]];
    let body = |length: f64| json!({"edit": edit, "ends": ends, "length_m": length});
    let height = |length| {
        place.post("measure", &body(length)).json()["height_m"]
            .as_f64()
            .unwrap()
    };
    assert!((height(2.0) / height(1.0) - 2.0).abs() < 1e-9);
    let lifted = json!({"objects": [{"of": 0}], "height_m": height(1.0)});
    let again = json!({"edit": lifted, "ends": ends, "length_m": 1.0});
    let same = place.post("measure", &again).json()["height_m"]
        .as_f64()
        .unwrap();
    // The position is written to a hundredth of a millimetre.
    assert!((same - height(1.0)).abs() < 1e-4, "{same} {}", height(1.0));
    // Kerbs that meet in the middle of row 100, the picture's: a level view.
    let lines = json!({"first": [[[0.0, 200.0], [75.0, 150.0]], [[300.0, 200.0], [225.0, 150.0]]]});
    let found = place
        .post("solve", &json!({"edit": edit, "lines": lines}))
        .json();
    assert!(
        found["turn"]["pitch_deg"].as_f64().unwrap().abs() < 1e-3,
        "{found}"
    );
    assert_eq!(found["found_fov"], false);
}
