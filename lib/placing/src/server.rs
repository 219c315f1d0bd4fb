//! The server of the page.
use std::io::{Read, Write};
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::{Context, anyhow};
use dipir_cli::exit::describe;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use tiny_http::{Request, Server, StatusCode};

use crate::desk::Desk;
use crate::edit::Edit;
use crate::gate::{Gate, Head, MASK, MOST_JSON, Refusal, Route, token};
use crate::vanishing::Lines;

/// The page's files: name behind the token, type, text.
const FILES: [(&str, &str, &str); 9] = [
    (
        "",
        "text/html; charset=utf-8",
        include_str!("page/index.html"),
    ),
    (
        "style.css",
        "text/css; charset=utf-8",
        include_str!("page/style.css"),
    ),
    ("main.js", JAVASCRIPT, include_str!("page/main.js")),
    ("api.js", JAVASCRIPT, include_str!("page/api.js")),
    ("history.js", JAVASCRIPT, include_str!("page/history.js")),
    ("canvas.js", JAVASCRIPT, include_str!("page/canvas.js")),
    ("tools.js", JAVASCRIPT, include_str!("page/tools.js")),
    ("dial.js", JAVASCRIPT, include_str!("page/dial.js")),
    ("panel.js", JAVASCRIPT, include_str!("page/panel.js")),
];
const JAVASCRIPT: &str = "text/javascript; charset=utf-8";

/// What is asked for beside the files.
const GETS: [&str; 3] = ["state", "photo.png", "mask.bin"];
const POSTS: [&str; 6] = ["view", "draft", "solve", "measure", "save", MASK];

/// Nothing is loaded from elsewhere, and no other page may show this one.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Threads that answer: one may render, others draw lines meanwhile.
const THREADS: usize = 4;
/// How soon a thread sees that it should end.
const PAUSE: Duration = Duration::from_millis(200);

/// A server that listens.
pub struct Place {
    server: Arc<Server>,
    gate: Arc<Gate>,
    desk: Arc<Desk>,
    routes: Arc<Vec<Route>>,
}

impl Place {
    /// Listens on 127.0.0.1 alone, at `port`, or at one that the system chooses if that is 0.
    ///
    /// # Errors
    /// If the port is taken.
    pub fn listen(desk: Desk, port: u16) -> anyhow::Result<Self> {
        let server = Server::http((Ipv4Addr::LOCALHOST, port))
            .map_err(|e| anyhow!("cannot listen on 127.0.0.1:{port}: {e}; try another --port"))?;
        let address = server.server_addr().to_ip();
        let address = address.context("the server has no address")?;
        let gate = Gate {
            authority: address.to_string(),
            token: token()?,
            mask_bytes: desk.mask_bytes(),
        };
        let get = |path| Route { path, posts: false };
        let post = |path| Route { path, posts: true };
        let routes = FILES.iter().map(|f| get(f.0));
        let routes = routes.chain(GETS.map(get)).chain(POSTS.map(post));
        Ok(Self {
            server: Arc::new(server),
            gate: Arc::new(gate),
            desk: Arc::new(desk),
            routes: Arc::new(routes.collect()),
        })
    }

    /// The address to open, with its token.
    pub fn address(&self) -> String {
        format!("http://{}/{}/", self.gate.authority, self.gate.token)
    }

    /// Answers until `stop`.
    pub fn serve(&self, stop: &AtomicBool) {
        thread::scope(|scope| {
            for _ in 0..THREADS {
                scope.spawn(|| {
                    while !stop.load(Ordering::Relaxed) {
                        match self.server.recv_timeout(PAUSE) {
                            Ok(Some(request)) => self.answer(request),
                            Ok(None) => {}
                            // A connection that broke off; the pause keeps a lasting error cheap.
                            Err(_) => thread::sleep(PAUSE),
                        }
                    }
                });
            }
        });
    }

    fn answer(&self, mut request: Request) {
        let header = |name: &'static str| {
            let found = request.headers().iter().find(|h| h.field.equiv(name));
            found.map(|h| h.value.as_str().to_owned())
        };
        let (host, origin) = (header("Host"), header("Origin"));
        let head = Head {
            method: request.method().as_str(),
            url: request.url(),
            host: host.as_deref(),
            origin: origin.as_deref(),
            length: request.body_length(),
            is_chunked: header("Transfer-Encoding").is_some(),
        };
        let admitted = self.gate.admit(&head, &self.routes);
        let answer = match admitted {
            Err(refusal) => Answer::refusal(&refusal),
            Ok(route) => {
                let most = match route.path {
                    MASK => self.gate.mask_bytes,
                    _ => MOST_JSON,
                };
                let mut body = Vec::new();
                let mut reader = request.as_reader().take(most as u64);
                match reader.read_to_end(&mut body) {
                    Ok(_) => self.route(route, body),
                    Err(e) => Answer::error(&e.into()),
                }
            }
        };
        // A body that is too long is thrown away while the answer is sent, for as long as it comes:
        // no thread that serves others waits for it.
        let respond = move || {
            // Who broke the connection off does not wait for an answer.
            let _ = answer.send(request);
        };
        match admitted {
            Ok(_) => respond(),
            Err(_) => drop(thread::spawn(respond)),
        }
    }

    fn route(&self, route: Route, body: Vec<u8>) -> Answer {
        if let Some((_, kind, text)) = FILES.iter().find(|f| f.0 == route.path && !route.posts) {
            return Answer::new(200, kind, text.as_bytes().to_vec());
        }
        let desk = &self.desk;
        let answer = match route.path {
            "state" => desk.state().map(Answer::json),
            "photo.png" => Ok(Answer::new(200, "image/png", desk.photo().to_vec())),
            "mask.bin" => Ok(Answer::new(
                200,
                "application/octet-stream",
                desk.own_mask(),
            )),
            MASK => desk.paint(body).map(|()| Answer::json(json!({}))),
            "view" => parsed::<ViewAsked>(&body)
                .and_then(|a| desk.view(&a.edit, a.grid))
                .map(Answer::json),
            "solve" => parsed::<SolveAsked>(&body)
                .and_then(|a| desk.solve(&a.edit, &a.lines))
                .map(|found| Answer::json(json!(found))),
            "measure" => parsed::<MeasureAsked>(&body)
                .and_then(|a| desk.measure(&a.edit, a.ends, a.length_m))
                .map(|height| Answer::json(json!({"height_m": height}))),
            "save" => parsed::<Edit>(&body)
                .and_then(|edit| desk.save(&edit))
                .and_then(|written| Ok((written, desk.state()?)))
                .map(|(written, state)| Answer::json(json!({"written": written, "state": state}))),
            "draft" => parsed::<DraftAsked>(&body).and_then(|a| self.draft(&a)),
            other => Err(anyhow!("{other} is not answered")),
        };
        answer.unwrap_or_else(|e| Answer::error(&e))
    }

    fn draft(&self, asked: &DraftAsked) -> anyhow::Result<Answer> {
        let samples = asked.samples.clamp(1, MOST_SAMPLES);
        Ok(match self.desk.draft(&asked.edit, samples)? {
            Err(_) => Answer::new(409, "text/plain", b"a newer draft was asked for".to_vec()),
            Ok(None) => Answer::new(204, "text/plain", Vec::new()),
            Ok(Some(crop)) => {
                let mut answer = Answer::new(200, "image/png", crop.png);
                let about = json!({"place": crop.place, "light": crop.light});
                answer.about = Some(about.to_string());
                answer
            }
        })
    }
}

/// Most paths a pixel of a draft.
const MOST_SAMPLES: u32 = 64;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewAsked {
    edit: Edit,
    grid: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct DraftAsked {
    edit: Edit,
    samples: u32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SolveAsked {
    edit: Edit,
    lines: Lines,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MeasureAsked {
    edit: Edit,
    ends: [[f64; 2]; 2],
    length_m: f64,
}

fn parsed<T: DeserializeOwned>(body: &[u8]) -> anyhow::Result<T> {
    serde_json::from_slice(body).context("the request is not understood")
}

/// What is sent back.
struct Answer {
    status: u16,
    kind: &'static str,
    body: Vec<u8>,
    /// What a picture shows, as JSON.
    about: Option<String>,
}

impl Answer {
    fn new(status: u16, kind: &'static str, body: Vec<u8>) -> Self {
        Self {
            status,
            kind,
            body,
            about: None,
        }
    }

    fn json(value: serde_json::Value) -> Self {
        Self::new(200, "application/json", value.to_string().into_bytes())
    }

    fn error(error: &anyhow::Error) -> Self {
        let text = json!({"error": describe(error)}).to_string();
        Self::new(422, "application/json", text.into_bytes())
    }

    fn refusal(refusal: &Refusal) -> Self {
        let text = format!("{refusal}\n").into_bytes();
        Self::new(refusal.status, "text/plain; charset=utf-8", text)
    }

    /// Answers `request`, after which the client closes the connection. The pool of threads in `tiny_http`
    /// 0.12 can leave a new connection waiting for ever while others are kept open, as browsers do.
    fn send(self, request: Request) -> std::io::Result<()> {
        let (status, length) = (self.status, self.body.len());
        let reason = StatusCode(status).default_reason_phrase();
        let mut head = format!(
            "HTTP/1.1 {status} {reason}\r\nConnection: close\r\nContent-Length: {length}\r\n"
        );
        let headers = [
            ("Content-Type", self.kind),
            ("Content-Security-Policy", POLICY),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cache-Control", "no-store"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cross-Origin-Opener-Policy", "same-origin"),
        ];
        let about = self.about.iter().map(|a| ("X-Draft", a.as_str()));
        for (name, value) in headers.into_iter().chain(about) {
            // What a configuration says must not end a header.
            let value: String = value.chars().filter(|c| !c.is_control()).collect();
            head += &format!("{name}: {value}\r\n");
        }
        head += "\r\n";
        let mut writer = request.into_writer();
        writer.write_all(head.as_bytes())?;
        writer.write_all(&self.body)?;
        writer.flush()
    }
}
