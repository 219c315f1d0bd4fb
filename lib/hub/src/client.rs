//! Requests to the hub.

use std::io::Read;
use std::time::Duration;

use serde::Deserialize;
use ureq::Agent;
use ureq::http::header::{AUTHORIZATION, RANGE};

use crate::error::{Error, Result};

/// Seconds without a byte after which a connection counts as dead.
const SILENCE_S: u64 = 60;
/// Bytes of a listing at most; repositories of models have a few kilobytes.
const LISTING_BYTES: u64 = 16 << 20;

/// A hub at one address.
pub struct Hub {
    endpoint: String,
    token: Option<String>,
    agent: Agent,
}

impl std::fmt::Debug for Hub {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Without the token.
        f.debug_struct("Hub")
            .field("endpoint", &self.endpoint)
            .finish()
    }
}

/// A file of a repository.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteFile {
    /// Name in the repository, parts separated by `/`.
    pub path: String,
    /// Bytes, where the hub says.
    pub size: Option<u64>,
    /// SHA-256 of large files, hexadecimal.
    pub sha256: Option<String>,
    /// Git's hash of the others: SHA-1 of `blob <bytes>\0` and the content.
    pub git_hash: Option<String>,
}

/// A repository as it was at one commit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Revision {
    /// `owner/name`.
    pub repo: String,
    /// The commit that a branch or tag stood for.
    pub commit: String,
    /// Its files.
    pub files: Vec<RemoteFile>,
}

#[derive(Deserialize)]
struct Listing {
    sha: Option<String>,
    siblings: Vec<Sibling>,
}

#[derive(Deserialize)]
struct Sibling {
    rfilename: String,
    size: Option<u64>,
    #[serde(rename = "blobId")]
    blob_id: Option<String>,
    lfs: Option<Lfs>,
}

#[derive(Deserialize)]
struct Lfs {
    sha256: Option<String>,
    size: Option<u64>,
}

impl Hub {
    /// A hub at `endpoint`, such as `https://huggingface.co`. The token is
    /// sent to the endpoint only, not to where it redirects.
    pub fn new(endpoint: &str, token: Option<String>) -> Result<Self> {
        let endpoint = endpoint.trim_end_matches('/');
        if !endpoint.starts_with("https://") && !endpoint.starts_with("http://") {
            return Err(Error::Name {
                what: "endpoint",
                value: endpoint.into(),
                accepted: "an address that starts with https:// or http://",
            });
        }
        let silence = Some(Duration::from_secs(SILENCE_S));
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .timeout_connect(silence)
            .timeout_recv_response(silence)
            .timeout_per_read(silence)
            .user_agent(concat!("dipir/", env!("CARGO_PKG_VERSION")))
            .build();
        Ok(Self {
            endpoint: endpoint.into(),
            token,
            agent: config.new_agent(),
        })
    }

    /// Lists the files of `repo` (`owner/name`) at a branch, tag or commit.
    pub fn revision(&self, repo: &str, revision: &str) -> Result<Revision> {
        check_repo(repo)?;
        check_revision(revision)?;
        let url = format!(
            "{}/api/models/{repo}/revision/{revision}?blobs=true",
            self.endpoint
        );
        let protocol = |message: String| Error::Protocol {
            url: url.clone(),
            message,
        };
        let mut response = self.get(&url, 0)?;
        let text = response
            .body_mut()
            .with_config()
            .limit(LISTING_BYTES)
            .read_to_vec()
            .map_err(|source| network(&url, source))?;
        let listing: Listing = serde_json::from_slice(&text)
            .map_err(|e| protocol(format!("the answer is no list of files: {e}")))?;
        let commit = listing
            .sha
            .filter(|sha| is_hex(sha))
            .ok_or_else(|| protocol("the answer names no commit".into()))?;
        let files = listing
            .siblings
            .into_iter()
            .map(|s| RemoteFile {
                size: s.lfs.as_ref().and_then(|l| l.size).or(s.size),
                git_hash: s.blob_id.filter(|_| s.lfs.is_none()),
                sha256: s.lfs.and_then(|l| l.sha256),
                path: s.rfilename,
            })
            .collect();
        Ok(Revision {
            repo: repo.into(),
            commit,
            files,
        })
    }

    /// The address of a file.
    pub(crate) fn address(&self, revision: &Revision, path: &str) -> String {
        let Revision { repo, commit, .. } = revision;
        format!("{}/{repo}/resolve/{commit}/{path}", self.endpoint)
    }

    /// Opens `url` from byte `first` on; returns the reader and whether it
    /// starts there, or at the beginning, where the server cannot resume.
    pub(crate) fn open(&self, url: &str, first: u64) -> Result<(impl Read + use<>, bool)> {
        let response = self.get(url, first)?;
        let partial = response.status().as_u16() == 206;
        Ok((response.into_body().into_reader(), first == 0 || partial))
    }

    fn get(&self, url: &str, first: u64) -> Result<ureq::http::Response<ureq::Body>> {
        let mut request = self.agent.get(url);
        if first > 0 {
            request = request.header(RANGE, format!("bytes={first}-"));
        }
        if let Some(token) = &self.token {
            request = request.header(AUTHORIZATION, format!("Bearer {token}"));
        }
        let response = request.call().map_err(|source| network(url, source))?;
        let status = response.status().as_u16();
        if matches!(status, 200 | 206) {
            return Ok(response);
        }
        Err(Error::Status {
            url: url.into(),
            status,
            remedy: remedy(status, self.token.is_some()),
        })
    }
}

fn network(url: &str, source: ureq::Error) -> Error {
    Error::Network {
        url: url.into(),
        source: Box::new(source),
    }
}

fn remedy(status: u16, with_token: bool) -> String {
    match status {
        401 | 403 if with_token => {
            "the token in HF_TOKEN does not open it; accept the model's terms on its page".into()
        }
        // The hub does not tell what is private from what does not exist.
        401 | 403 => "there is no such model, or it is gated: check the name, or accept its terms on its page and set HF_TOKEN".into(),
        404 => "there is no such model, revision or file; check the names".into(),
        429 => "too many requests; wait a while and run again".into(),
        500.. => "it has trouble of its own; run again later".into(),
        _ => "check the names and the endpoint".into(),
    }
}

fn is_hex(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| b.is_ascii_hexdigit())
}

/// Whether `text` may stand in a path of an address as it is.
fn is_plain(text: &str) -> bool {
    !text.is_empty()
        && text != "."
        && text != ".."
        && text
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b))
}

fn check_repo(repo: &str) -> Result<()> {
    let mut parts = repo.split('/');
    let plain = parts.next().is_some_and(is_plain) && parts.next().is_none_or(is_plain);
    if plain && parts.next().is_none() {
        return Ok(());
    }
    Err(Error::Name {
        what: "repository",
        value: repo.into(),
        accepted: "owner/name of letters, digits, -, _ and .",
    })
}

fn check_revision(revision: &str) -> Result<()> {
    if is_plain(revision) {
        return Ok(());
    }
    Err(Error::Name {
        what: "revision",
        value: revision.into(),
        accepted: "a branch, tag or commit of letters, digits, -, _ and .",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_would_leave_the_repository_are_refused() {
        for good in ["owner/name", "name", "a-b/c_d.e"] {
            assert!(check_repo(good).is_ok(), "{good}");
        }
        for bad in [
            "", "/", "a/", "../x", "a/..", "a/b/c", "a b/c", "a/b?x=1", "a/b#c", "a%2f/b",
        ] {
            let message = check_repo(bad).expect_err(bad).to_string();
            assert!(message.contains("owner/name"), "{message}");
        }
        assert!(check_revision("fp16").is_ok() && check_revision("../main").is_err());
        assert!(Hub::new("huggingface.co", None).is_err());
    }

    #[test]
    fn a_token_is_not_shown() {
        let hub = Hub::new("https://example.org/", Some("secret".into())).expect("hub");
        assert!(!format!("{hub:?}").contains("secret"));
    }
}
