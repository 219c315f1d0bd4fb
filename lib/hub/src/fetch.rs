//! A model folder from a hub: whole, verified, or not there at all.

use std::fs::{self, File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::Duration;

use ring::digest::{Context, SHA1_FOR_LEGACY_USE_ONLY, SHA256};
use serde::{Deserialize, Serialize};

use crate::client::{Hub, RemoteFile, Revision};
use crate::error::{Error, Result, io};

/// Name of the file in a model folder that says where the others come from.
pub const SOURCE_FILE: &str = "source.json";
/// End of the name of a file that is being received.
const PART: &str = "part";
/// Bytes between two looks at the interruption.
const CHUNK: usize = 1 << 18;

/// Where a model folder comes from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Source {
    /// `owner/name`.
    pub repo: String,
    /// Commit.
    pub commit: String,
    /// Names of the files in the order of fetching.
    pub files: Vec<String>,
}

/// How far it is.
#[derive(Clone, Copy, Debug)]
pub struct Progress<'a> {
    /// The file at hand.
    pub path: &'a str,
    /// Bytes that are there, of all files.
    pub done: u64,
    /// Bytes of all files, as far as the hub says.
    pub total: u64,
}

/// What was done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Files of the model.
    pub files: usize,
    /// Their bytes.
    pub bytes: u64,
    /// Bytes that were received in this run.
    pub received: u64,
}

/// Fetches `files` of `revision` into the folder `partial` and verifies each.
/// What an earlier run left there is verified and kept, as long as it is of
/// the same commit. A broken connection is taken up again `retries` times a
/// file, after a pause that doubles. `progress` returns whether to go on.
pub fn fetch(
    hub: &Hub,
    revision: &Revision,
    files: &[RemoteFile],
    partial: &Path,
    retries: u32,
    mut progress: impl FnMut(Progress) -> bool,
) -> Result<Outcome> {
    let source = Source {
        repo: revision.repo.clone(),
        commit: revision.commit.clone(),
        files: files.iter().map(|f| f.path.clone()).collect(),
    };
    prepare(partial, &source)?;
    let mut run = Run {
        outcome: Outcome {
            files: files.len(),
            ..Outcome::default()
        },
        total: files
            .iter()
            .filter_map(|f| f.size)
            .fold(0, u64::saturating_add),
    };
    for file in files {
        let url = hub.address(revision, &file.path);
        let target = partial.join(&file.path);
        let part = part_of(&target);
        if let Some(parent) = target.parent() {
            fs::create_dir_all(parent).map_err(io("write", parent))?;
        }
        let before = run.outcome.bytes;
        if target.is_file() {
            run.outcome.bytes += length(&target)?;
            continue; // it got its name only after it was verified
        }
        let mut attempt = 0;
        loop {
            run.outcome.bytes = before;
            match run.receive(hub, &url, file, &part, &mut progress) {
                Ok(()) => break,
                Err(Error::Network { .. } | Error::Truncated { .. }) if attempt < retries => {
                    sleep(Duration::from_millis(500 << attempt.min(6)));
                    attempt += 1;
                }
                Err(error) => return Err(error),
            }
        }
        if let Err(error) = verify_file(file, &part) {
            // A part that could not be read may be whole: it stays.
            if let Error::Hash { .. } = &error {
                fs::remove_file(&part).map_err(io("remove", &part))?;
            }
            return Err(error);
        }
        fs::rename(&part, &target).map_err(io("write", &target))?;
    }
    Ok(run.outcome)
}

/// Compares every file of a folder with the hub's sizes and hashes.
pub fn verify(files: &[RemoteFile], folder: &Path) -> Result<()> {
    files.iter().try_for_each(|file| {
        verify_file(file, &folder.join(&file.path)).map_err(|error| match error {
            Error::Hash {
                path,
                kind,
                found,
                wanted,
            } => Error::Damaged {
                path: folder.join(path),
                kind,
                found,
                wanted,
            },
            other => other,
        })
    })
}

/// The name under which a file is received.
fn part_of(target: &Path) -> PathBuf {
    let mut name = target.file_name().unwrap_or_default().to_owned();
    name.push(".");
    name.push(PART);
    target.with_file_name(name)
}

fn length(path: &Path) -> Result<u64> {
    Ok(fs::metadata(path).map_err(io("read", path))?.len())
}

/// Makes `partial` a folder of this source: the files of its note that this source does not want go, and a folder
/// without a note is another's and is refused.
fn prepare(partial: &Path, source: &Source) -> Result<()> {
    let note = partial.join(SOURCE_FILE);
    let earlier = fs::read(&note)
        .ok()
        .and_then(|text| serde_json::from_slice::<Source>(&text).ok());
    match &earlier {
        // The same commit, maybe in another precision.
        Some(e) if e.repo == source.repo && e.commit == source.commit => {
            remove_listed(partial, e, &source.files)?;
        }
        Some(e) => remove_listed(partial, e, &[])?,
        None if is_free(partial)? => {}
        None => {
            return Err(Error::Foreign {
                path: partial.into(),
            });
        }
    }
    fs::create_dir_all(partial).map_err(io("write", partial))?;
    let mut text = serde_json::to_vec_pretty(source).map_err(|e| Error::Io {
        action: "write",
        path: note.clone(),
        source: e.into(),
    })?;
    text.push(b'\n');
    // Written beside it first, so that a process killed here leaves a note that can be read.
    let beside = part_of(&note);
    fs::write(&beside, text)
        .and_then(|()| fs::rename(&beside, &note))
        .map_err(io("write", &note))
}

/// Whether `folder` is missing, empty, or holds a note that was begun.
fn is_free(folder: &Path) -> Result<bool> {
    let found = match fs::symlink_metadata(folder) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(true),
        found => found.map_err(io("read", folder))?,
    };
    if !found.is_dir() {
        return Ok(false);
    }
    let begun = part_of(Path::new(SOURCE_FILE));
    for entry in fs::read_dir(folder).map_err(io("read", folder))? {
        if Path::new(&entry.map_err(io("read", folder))?.file_name()) != begun {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Removes the files of an earlier fetch but those to `keep`, whole or in part, and nothing else.
fn remove_listed(partial: &Path, earlier: &Source, keep: &[String]) -> Result<()> {
    use std::path::Component;
    let is_inside = |name: &&String| {
        let mut parts = Path::new(name).components();
        parts.all(|c| matches!(c, Component::Normal(_)))
    };
    let gone = earlier.files.iter().filter(|name| !keep.contains(name));
    for name in gone.filter(is_inside) {
        let path = partial.join(name);
        for path in [part_of(&path), path] {
            match fs::remove_file(&path) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                    return Err(io("remove", &path)(e));
                }
                _ => {}
            }
        }
    }
    Ok(())
}

struct Run {
    outcome: Outcome,
    total: u64,
}

impl Run {
    /// Appends to `part` until the file is whole.
    fn receive(
        &mut self,
        hub: &Hub,
        url: &str,
        file: &RemoteFile,
        part: &Path,
        progress: &mut impl FnMut(Progress) -> bool,
    ) -> Result<()> {
        let mut there = if part.is_file() { length(part)? } else { 0 };
        let mut out = OpenOptions::new()
            .create(true)
            .append(true)
            .open(part)
            .map_err(io("write", part))?;
        // A file that is already too long cannot be continued.
        if file.size.is_some_and(|size| there > size) {
            out.set_len(0).map_err(io("write", part))?;
            there = 0;
        }
        self.outcome.bytes += there;
        if file.size == Some(there) && there > 0 {
            return Ok(());
        }
        let (mut reader, continued) = match hub.open(url, there) {
            // Nothing follows the part, and without a size it is not known to be whole: it is received anew.
            Err(Error::Status { status: 416, .. }) if there > 0 => (hub.open(url, 0)?.0, false),
            opened => opened?,
        };
        if !continued {
            out.set_len(0).map_err(io("write", part))?;
            self.outcome.bytes -= there;
            there = 0;
        }
        let mut buffer = vec![0; CHUNK];
        loop {
            let report = Progress {
                path: &file.path,
                done: self.outcome.bytes,
                total: self.total,
            };
            if !progress(report) {
                return Err(Error::Interrupted);
            }
            let count = match reader.read(&mut buffer) {
                Ok(count) => count,
                // An early end and a silent line look alike to the user.
                Err(_) if file.size.is_some_and(|size| there < size) => 0,
                Err(source) => {
                    return Err(Error::Network {
                        url: url.into(),
                        source: Box::new(source.into()),
                    });
                }
            };
            if count == 0 {
                break;
            }
            out.write_all(&buffer[..count]).map_err(io("write", part))?;
            there += count as u64;
            self.outcome.bytes += count as u64;
            self.outcome.received += count as u64;
        }
        match file.size {
            Some(wanted) if there < wanted => Err(Error::Truncated {
                url: url.into(),
                found: there,
                wanted,
            }),
            _ => out.sync_all().map_err(io("write", part)),
        }
    }
}

/// Compares size and hash with those that the hub states, if it states any.
fn verify_file(file: &RemoteFile, part: &Path) -> Result<()> {
    let size = length(part)?;
    let differs = |kind, found: String, wanted: &str| {
        Err(Error::Hash {
            path: file.path.clone(),
            kind,
            found,
            wanted: wanted.into(),
        })
    };
    if let Some(wanted) = file.size.filter(|&wanted| wanted != size) {
        return differs("size", size.to_string(), &wanted.to_string());
    }
    if let Some(wanted) = &file.sha256 {
        let found = digest(Context::new(&SHA256), part)?;
        if !found.eq_ignore_ascii_case(wanted) {
            return differs("SHA-256", found, wanted);
        }
    }
    if let Some(wanted) = &file.git_hash {
        let mut context = Context::new(&SHA1_FOR_LEGACY_USE_ONLY);
        context.update(format!("blob {size}\0").as_bytes());
        let found = digest(context, part)?;
        if !found.eq_ignore_ascii_case(wanted) {
            return differs("git hash", found, wanted);
        }
    }
    Ok(())
}

fn digest(mut context: Context, path: &Path) -> Result<String> {
    let mut file = File::open(path).map_err(io("read", path))?;
    let mut buffer = vec![0; CHUNK];
    loop {
        let count = file.read(&mut buffer).map_err(io("read", path))?;
        if count == 0 {
            break;
        }
        context.update(&buffer[..count]);
    }
    let digest = context.finish();
    Ok(digest.as_ref().iter().map(|b| format!("{b:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_an_earlier_fetch_lists_is_removed() {
        let folder = tempfile::tempdir().expect("folder");
        let partial = folder.path().join(".model.partial");
        let source = |commit: &str| Source {
            repo: "a/b".into(),
            commit: commit.into(),
            files: vec!["unet/x".into(), "../thesis".into()],
        };
        prepare(&partial, &source("1")).expect("new");
        fs::create_dir(partial.join("unet")).expect("folder");
        for name in ["unet/x", "unet/x.part", "notes", "../thesis"] {
            fs::write(partial.join(name), "x").expect("write");
        }
        prepare(&partial, &source("1")).expect("the same");
        assert!(partial.join("unet/x").exists());
        prepare(&partial, &source("2")).expect("another");
        assert!(!partial.join("unet/x").exists() && !partial.join("unet/x.part").exists());
        assert!(partial.join("notes").exists() && partial.join("../thesis").exists());
        fs::remove_file(partial.join(SOURCE_FILE)).expect("remove");
        let error = prepare(&partial, &source("2")).expect_err("no note");
        assert!(error.to_string().contains("did not begin"), "{error}");
        assert!(partial.join("notes").exists());
    }

    #[test]
    fn weights_of_another_precision_do_not_stay_beside_those_that_are_wanted() {
        let folder = tempfile::tempdir().expect("folder");
        let partial = folder.path().join(".model.partial");
        let source = |weights: &str| Source {
            repo: "a/b".into(),
            commit: "1".into(),
            files: vec!["config.json".into(), weights.into()],
        };
        prepare(&partial, &source("full")).expect("new");
        for name in ["config.json", "full", "full.part"] {
            fs::write(partial.join(name), "x").expect("write");
        }
        prepare(&partial, &source("half")).expect("the same commit");
        assert!(partial.join("config.json").exists());
        assert!(!partial.join("full").exists() && !partial.join("full.part").exists());
    }

    /// Answers requests on this machine: `content`, or that there is nothing from a byte on.
    fn serve(content: &'static str) -> String {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("address"));
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let mut stream = stream.expect("connection");
                let (mut request, mut buffer) = (vec![], [0; 1024]);
                while !request.ends_with(b"\r\n\r\n") {
                    let count = stream.read(&mut buffer).expect("request");
                    assert!(count > 0, "a request ends with an empty line");
                    request.extend(&buffer[..count]);
                }
                let request = String::from_utf8_lossy(&request).to_lowercase();
                let (status, body) = match request.contains("\nrange:") {
                    true => ("416 Range Not Satisfiable", ""),
                    false => ("200 OK", content),
                };
                let length = body.len();
                let answer = format!(
                    "HTTP/1.1 {status}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n{body}"
                );
                stream.write_all(answer.as_bytes()).expect("answer");
            }
        });
        address
    }

    #[test]
    fn a_part_of_unknown_size_that_cannot_go_on_is_received_anew() {
        let folder = tempfile::tempdir().expect("folder");
        let hub = Hub::new(&serve("hello\n"), None).expect("hub");
        let files = [RemoteFile {
            path: "x".into(),
            size: None,
            sha256: None,
            git_hash: Some("ce013625030ba8dba906f756967f9e9ca394464a".into()),
        }];
        let revision = Revision {
            repo: "a/b".into(),
            commit: "1".into(),
            files: files.to_vec(),
        };
        let source = Source {
            repo: "a/b".into(),
            commit: "1".into(),
            files: vec!["x".into()],
        };
        // The run before was killed after the last byte.
        prepare(folder.path(), &source).expect("new");
        fs::write(folder.path().join("x.part"), "hello\n").expect("write");
        let outcome = fetch(&hub, &revision, &files, folder.path(), 0, |_| true).expect("whole");
        assert_eq!((outcome.bytes, outcome.received), (6, 6));
        let text = fs::read_to_string(folder.path().join("x")).expect("read");
        assert_eq!(text, "hello\n");
    }

    #[test]
    fn hashes_are_those_of_git_and_sha256() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("x.part");
        fs::write(&path, "hello\n").expect("write");
        let file = RemoteFile {
            path: "x".into(),
            size: Some(6),
            // `printf 'hello\n' | sha256sum` and `| git hash-object --stdin`.
            sha256: Some("5891b5b522d5df086d0ff0b110fbd9d21bb4fc7163af34d08286a2e846f6be03".into()),
            git_hash: Some("ce013625030ba8dba906f756967f9e9ca394464a".into()),
        };
        verify_file(&file, &path).expect("they agree");
        fs::write(&path, "hallo\n").expect("write");
        let message = verify_file(&file, &path).expect_err("changed").to_string();
        assert!(message.contains("x: its SHA-256 is"), "{message}");
        fs::write(&path, "hello").expect("write");
        let message = verify_file(&file, &path).expect_err("shorter").to_string();
        assert!(
            message.contains("its size is 5, the hub says 6"),
            "{message}"
        );
    }
}
