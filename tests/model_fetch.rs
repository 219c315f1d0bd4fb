//! `dipir-model fetch` against a hub on this machine, which may misbehave.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Arc, Mutex};

use ring::digest::{Context, SHA1_FOR_LEGACY_USE_ONLY, SHA256, digest};
use serde_json::{Value, json};
use tempfile::TempDir;

const MODEL: &str = env!("CARGO_BIN_EXE_dipir-model");
const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";
const UNET: &str = "unet/diffusion_pytorch_model.safetensors";

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// What the hub does wrong, and what it was asked.
#[derive(Default)]
struct Behaviour {
    /// Files of which only this many bytes are sent, on requests that start before them.
    cut: BTreeMap<String, usize>,
    /// Files of which another content is sent.
    forged: BTreeMap<String, Vec<u8>>,
    /// Answers `Range` requests with the whole file.
    ignores_ranges: bool,
    /// (path, first byte asked for, whether a token came along)
    requests: Vec<(String, usize, bool)>,
}

struct Server {
    address: String,
    files: Arc<BTreeMap<String, Vec<u8>>>,
    behaviour: Arc<Mutex<Behaviour>>,
}

impl Server {
    /// Serves the small model of the references, and files that nobody should want.
    fn start(change: impl FnOnce(&mut BTreeMap<String, Vec<u8>>)) -> Self {
        let root =
            PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("lib/diffusion/tests/references/sd15");
        let mut files = BTreeMap::new();
        for part in ["", "unet", "vae", "text_encoder", "tokenizer", "scheduler"] {
            for entry in fs::read_dir(root.join(part)).unwrap() {
                let path = entry.unwrap().path();
                if path.is_file() {
                    let name = path
                        .strip_prefix(&root)
                        .unwrap()
                        .to_str()
                        .unwrap()
                        .to_owned();
                    files.insert(name, fs::read(path).unwrap());
                }
            }
        }
        for unwanted in [
            "README.md",
            "model.ckpt",
            "unet/diffusion_pytorch_model.bin",
        ] {
            files.insert(unwanted.into(), b"not wanted".to_vec());
        }
        change(&mut files);
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let server = Self {
            address: format!("http://{}", listener.local_addr().unwrap()),
            files: Arc::new(files),
            behaviour: Arc::default(),
        };
        let (files, behaviour) = (server.files.clone(), server.behaviour.clone());
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let (files, behaviour) = (files.clone(), behaviour.clone());
                // A client that hangs up is none of the hub's business.
                std::thread::spawn(move || serve(stream, &files, &behaviour));
            }
        });
        server
    }

    fn fetch(&self, folder: &Path, args: &[&str]) -> Output {
        Command::new(MODEL)
            .args(["fetch", "toy/model", "--json", "--endpoint", &self.address])
            .args(args)
            .env_remove("HF_ENDPOINT")
            .env("HF_TOKEN", "token of the test")
            .env("NO_PROXY", "127.0.0.1")
            .current_dir(folder)
            .output()
            .unwrap()
    }

    #[track_caller]
    fn fetches(&self, folder: &Path, args: &[&str]) -> Value {
        let output = self.fetch(folder, args);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{stderr}");
        serde_json::from_slice(&output.stdout).unwrap()
    }

    #[track_caller]
    fn fails(&self, folder: &Path, args: &[&str], code: i32, part: &str) {
        let output = self.fetch(folder, args);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        assert!(stderr.contains(part), "{part:?} is not in: {stderr}");
    }

    fn behave(&self, change: impl FnOnce(&mut Behaviour)) {
        change(&mut self.behaviour.lock().unwrap());
    }

    fn asked_for(&self, path: &str) -> Vec<usize> {
        let behaviour = self.behaviour.lock().unwrap();
        let of_it = behaviour.requests.iter().filter(|r| r.0 == path);
        of_it.map(|r| r.1).collect()
    }
}

fn serve(
    mut stream: TcpStream,
    files: &BTreeMap<String, Vec<u8>>,
    behaviour: &Mutex<Behaviour>,
) -> std::io::Result<()> {
    let mut reader = BufReader::new(stream.try_clone()?);
    let mut request = String::new();
    reader.read_line(&mut request)?;
    let (mut first, mut token) = (0, false);
    loop {
        let mut line = String::new();
        reader.read_line(&mut line)?;
        let line = line.trim().to_lowercase();
        if line.is_empty() {
            break;
        }
        if let Some(range) = line.strip_prefix("range: bytes=") {
            first = range.trim_end_matches('-').parse().unwrap();
        }
        token |= line == "authorization: bearer token of the test";
    }
    let address = request.split(' ').nth(1).unwrap_or_default();
    let listing = "/api/models/toy/model/revision/main?blobs=true";
    let resolve = format!("/toy/model/resolve/{COMMIT}/");
    if address == listing {
        let body = list(files).to_string();
        return answer(&mut stream, "200 OK", body.len(), body.as_bytes());
    }
    if let Some(path) = address.strip_prefix(&resolve) {
        // Large files lie elsewhere, as on the real hub.
        if path.ends_with(".safetensors") {
            let head = format!(
                "HTTP/1.1 302 Found\r\nlocation: /elsewhere/{path}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
            );
            return stream.write_all(head.as_bytes());
        }
        return send(&mut stream, path, first, token, files, behaviour);
    }
    match address.strip_prefix("/elsewhere/") {
        Some(path) => send(&mut stream, path, first, token, files, behaviour),
        None => answer(&mut stream, "404 Not Found", 0, b""),
    }
}

/// Small files have git's hash, large ones their SHA-256.
fn list(files: &BTreeMap<String, Vec<u8>>) -> Value {
    let entry = |(path, bytes): (&String, &Vec<u8>)| {
        let mut git = Context::new(&SHA1_FOR_LEGACY_USE_ONLY);
        git.update(format!("blob {}\0", bytes.len()).as_bytes());
        git.update(bytes);
        let mut entry = json!({
            "rfilename": path, "size": bytes.len(), "blobId": hex(git.finish().as_ref()),
        });
        if path.ends_with(".safetensors") {
            entry["blobId"] = json!("0000");
            entry["lfs"] = json!({
                "sha256": hex(digest(&SHA256, bytes).as_ref()), "size": bytes.len(),
            });
        }
        entry
    };
    json!({"sha": COMMIT, "siblings": files.iter().map(entry).collect::<Vec<_>>()})
}

fn send(
    stream: &mut TcpStream,
    path: &str,
    first: usize,
    token: bool,
    files: &BTreeMap<String, Vec<u8>>,
    behaviour: &Mutex<Behaviour>,
) -> std::io::Result<()> {
    let mut behaviour = behaviour.lock().unwrap();
    behaviour.requests.push((path.into(), first, token));
    let Some(bytes) = behaviour.forged.get(path).or_else(|| files.get(path)) else {
        return answer(stream, "404 Not Found", 0, b"");
    };
    let first = if behaviour.ignores_ranges { 0 } else { first };
    let status = if first > 0 {
        "206 Partial Content"
    } else {
        "200 OK"
    };
    let cut = behaviour.cut.get(path).copied().filter(|&cut| cut > first);
    let end = cut.unwrap_or(bytes.len());
    answer(stream, status, bytes.len() - first, &bytes[first..end])
}

fn answer(stream: &mut TcpStream, status: &str, length: usize, body: &[u8]) -> std::io::Result<()> {
    let head =
        format!("HTTP/1.1 {status}\r\ncontent-length: {length}\r\nconnection: close\r\n\r\n");
    stream.write_all(head.as_bytes())?;
    stream.write_all(body)
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries
        .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

#[test]
fn a_model_arrives_whole_and_nothing_else_does() {
    let server = Server::start(|_| {});
    let folder = TempDir::new().unwrap();
    let done = server.fetches(folder.path(), &[]);
    assert_eq!(
        (&done["commit"], &done["already_there"]),
        (&json!(COMMIT), &json!(false))
    );
    let model = folder.path().join("model");
    for (path, bytes) in server.files.iter() {
        let wanted = ![
            "README.md",
            "model.ckpt",
            "unet/diffusion_pytorch_model.bin",
            "tokens.json",
        ]
        .contains(&path.as_str())
            && !path.starts_with("lora")
            && path != "expected.safetensors";
        assert_eq!(model.join(path).is_file(), wanted, "{path}");
        assert!(
            !wanted || fs::read(model.join(path)).unwrap() == *bytes,
            "{path}"
        );
    }
    assert_eq!(names(folder.path()), ["model"]);
    // The token goes to the hub, and not to where it redirects.
    let requests = server.behaviour.lock().unwrap().requests.clone();
    assert!(!requests.is_empty());
    for (path, _, token) in requests {
        assert_eq!(token, !path.ends_with(".safetensors"), "{path}");
    }
    // A second time, nothing is fetched; damage is found.
    let done = server.fetches(folder.path(), &[]);
    assert_eq!(done["already_there"], true);
    assert_eq!(server.asked_for(UNET).len(), 1);
    let mut bytes = fs::read(model.join(UNET)).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(model.join(UNET), bytes).unwrap();
    server.fails(folder.path(), &[], 1, "its SHA-256 is");
}

#[test]
fn a_broken_connection_is_taken_up_where_it_broke() {
    let server = Server::start(|_| {});
    let half = server.files[UNET].len() / 2;
    server.behave(|b| _ = b.cut.insert(UNET.into(), half));
    let folder = TempDir::new().unwrap();
    // In a later run ...
    server.fails(
        folder.path(),
        &["--retries", "0"],
        1,
        &format!("broke off after {half} of"),
    );
    assert_eq!(names(folder.path()), [".model.partial"]);
    let done = server.fetches(folder.path(), &["--retries", "0"]);
    assert_eq!(server.asked_for(UNET), [0, half]);
    assert!(done["received"].as_u64().unwrap() < done["bytes"].as_u64().unwrap());
    assert_eq!(
        server.asked_for("model_index.json").len(),
        1,
        "what is whole is not asked for again"
    );
    // ... in the same, and by a server that cannot continue.
    server.behave(|b| b.requests.clear());
    server.fetches(folder.path(), &["--to", "again/sd", "--retries", "1"]);
    assert_eq!(server.asked_for(UNET), [0, half]);
    server.behave(|b| b.requests.clear());
    server.fails(
        folder.path(),
        &["--to", "third", "--retries", "0"],
        1,
        "broke off",
    );
    server.behave(|b| {
        b.ignores_ranges = true;
        b.cut.clear();
    });
    server.fetches(folder.path(), &["--to", "third", "--retries", "0"]);
    assert_eq!(
        fs::read(folder.path().join("third").join(UNET)).unwrap(),
        server.files[UNET]
    );
}

#[test]
fn a_forged_file_is_refused_and_fetched_anew() {
    let server = Server::start(|_| {});
    let mut forged = server.files[UNET].clone();
    forged[100] ^= 1;
    server.behave(|b| _ = b.forged.insert(UNET.into(), forged));
    let folder = TempDir::new().unwrap();
    server.fails(folder.path(), &[], 1, "its SHA-256 is");
    assert!(!folder.path().join("model").exists());
    server.behave(|b| b.forged.clear());
    server.fetches(folder.path(), &[]);
    assert_eq!(server.asked_for(UNET), [0, 0]);
}

#[test]
fn what_is_no_model_is_said_before_anything_is_fetched() {
    let folder = TempDir::new().unwrap();
    let server = Server::start(|files| _ = files.remove(UNET));
    server.fails(
        folder.path(),
        &[],
        1,
        "unet: no diffusion_pytorch_model.safetensors, only pickles",
    );
    assert!(
        names(folder.path()).is_empty() && server.behaviour.lock().unwrap().requests.is_empty()
    );
    server.fails(
        folder.path(),
        &["--revision", "nowhere"],
        1,
        "404: there is no such model, revision or file",
    );
    server.fails(
        folder.path(),
        &["--revision", "../main"],
        2,
        "revision \"../main\"",
    );
    server.fails(
        folder.path(),
        &["--endpoint", "ftp://x"],
        2,
        "cannot be used multiple times",
    );
    // Whole files, but a UNet of another width than its configuration says.
    let server = Server::start(|files| {
        let text = String::from_utf8(files["unet/config.json"].clone()).unwrap();
        let mut config: Value = serde_json::from_str(&text).unwrap();
        config["block_out_channels"] = json!([16, 32, 64]);
        files.insert("unet/config.json".into(), config.to_string().into_bytes());
    });
    server.fails(folder.path(), &[], 1, "does not load");
    assert!(!folder.path().join("model").exists());
}

#[test]
fn a_folder_of_something_else_is_left_alone() {
    let server = Server::start(|_| {});
    let folder = TempDir::new().unwrap();
    fs::create_dir(folder.path().join("model")).unwrap();
    fs::write(folder.path().join("model/precious.txt"), "mine").unwrap();
    server.fails(folder.path(), &[], 2, "name another folder with --to");
    assert_eq!(names(&folder.path().join("model")), ["precious.txt"]);
    // An empty one is as good as none.
    fs::create_dir(folder.path().join("empty")).unwrap();
    server.fetches(folder.path(), &["--to", "empty"]);
    assert!(folder.path().join("empty/model_index.json").is_file());
}

#[test]
fn a_hub_that_is_not_there_is_named() {
    let folder = TempDir::new().unwrap();
    let closed = TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap();
    let output = Command::new(MODEL)
        .args(["fetch", "toy/model"])
        .env("HF_ENDPOINT", format!("http://{closed}"))
        .env("NO_PROXY", "127.0.0.1")
        .current_dir(folder.path())
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(
        stderr.contains(&closed.to_string()) && stderr.contains("check the network"),
        "{stderr}"
    );
}
