//! The server of the page.
use std::convert::Infallible;
use std::net::{Ipv4Addr, TcpListener};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, anyhow};
use dipir_cli::exit::describe;
use http_body_util::{BodyExt, Full, Limited};
use hyper::body::{Bytes, Incoming};
use hyper::header::{HeaderName, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Request, Response, StatusCode, header};
use hyper_util::rt::{TokioIo, TokioTimer};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use tokio::runtime;
use tokio::task::spawn_blocking;
use tokio::time::timeout;

use crate::desk::{Crop, Desk, Superseded};
use crate::edit::Edit;
use crate::gate::{Gate, Head, MASK, MOST_JSON, Refusal, Route, token};
use crate::patient::Patient;
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
const POSTS: [&str; 7] = ["view", "draft", "relight", "solve", "measure", "save", MASK];

/// Nothing is loaded from elsewhere, and no other page may show this one.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Most threads that compute an answer: one may render, others draw lines meanwhile.
const THREADS: usize = 8;
/// Most connections at once; a browser keeps six.
const CONNECTIONS: usize = 128;
/// How soon the server sees that it should end.
const PAUSE: Duration = Duration::from_millis(200);
/// Longest wait for the head of a request, for its body, and for a reader who takes nothing of the answer.
const PATIENCE: Duration = Duration::from_secs(30);

/// A server that listens.
pub struct Place {
    listener: TcpListener,
    site: Arc<Site>,
}

/// What is served, and to whom.
struct Site {
    gate: Gate,
    desk: Desk,
    routes: Vec<Route>,
}

impl Place {
    /// Listens on 127.0.0.1 alone, at `port`, or at one that the system chooses if that is 0.
    ///
    /// # Errors
    /// If the port is taken.
    pub fn listen(desk: Desk, port: u16) -> anyhow::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))
            .with_context(|| format!("cannot listen on 127.0.0.1:{port}; try another --port"))?;
        let gate = Gate {
            authority: listener.local_addr()?.to_string(),
            token: token()?,
            mask_bytes: desk.mask_bytes(),
        };
        let get = |path| Route { path, posts: false };
        let post = |path| Route { path, posts: true };
        let routes = FILES.iter().map(|f| get(f.0));
        let routes = routes.chain(GETS.map(get)).chain(POSTS.map(post)).collect();
        let site = Arc::new(Site { gate, desk, routes });
        Ok(Self { listener, site })
    }

    /// The address to open, with its token.
    pub fn address(&self) -> String {
        let gate = &self.site.gate;
        format!("http://{}/{}/", gate.authority, gate.token)
    }

    /// Answers until `stop`. A picture that is being rendered then is not waited for.
    ///
    /// # Errors
    /// If the system gives no threads or no events.
    pub fn serve(&self, stop: &AtomicBool) -> anyhow::Result<()> {
        let runtime = runtime::Builder::new_current_thread()
            .enable_all()
            .max_blocking_threads(THREADS)
            .build()
            .context("the server cannot start")?;
        let done = runtime.block_on(self.accept(stop));
        runtime.shutdown_background();
        done.context("the server ended")
    }

    async fn accept(&self, stop: &AtomicBool) -> std::io::Result<()> {
        let listener = self.listener.try_clone()?;
        listener.set_nonblocking(true)?;
        let listener = tokio::net::TcpListener::from_std(listener)?;
        // Each connection holds one.
        let seats = Arc::new(());
        while !stop.load(Ordering::Relaxed) {
            let stream = match timeout(PAUSE, listener.accept()).await {
                Err(_) => continue,
                Ok(Ok((stream, _))) => stream,
                // A connection that broke off; the pause keeps a lasting error cheap.
                Ok(Err(_)) => {
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
            };
            // Files that are read and saved need descriptors, too.
            let seat = seats.clone();
            if Arc::strong_count(&seats) > CONNECTIONS + 1 {
                continue;
            }
            let site = self.site.clone();
            let service = service_fn(move |request| site.clone().answer(request));
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(PATIENCE);
            let stream = TokioIo::new(Patient::new(stream, PATIENCE));
            let connection = http.serve_connection(stream, service);
            // Who breaks a connection off does not wait for an answer.
            tokio::spawn(async move {
                drop(connection.await);
                drop(seat);
            });
        }
        Ok(())
    }
}

impl Site {
    async fn answer(
        self: Arc<Self>,
        request: Request<Incoming>,
    ) -> Result<Response<Full<Bytes>>, Infallible> {
        let answer = match self.admit(&request) {
            Err(refusal) => Answer::refusal(&refusal),
            Ok(route) => match self.body(route, request.into_body()).await {
                Err(e) => Answer::error(&e),
                Ok(body) => spawn_blocking(move || self.route(route, &body))
                    .await
                    .unwrap_or_else(|e| Answer::error(&e.into())),
            },
        };
        Ok(answer.response())
    }

    fn admit(&self, request: &Request<Incoming>) -> Result<Route, Refusal> {
        let header = |name: HeaderName| request.headers().get(name)?.to_str().ok();
        let url = request.uri().to_string();
        let head = Head {
            method: request.method().as_str(),
            url: &url,
            host: header(header::HOST),
            origin: header(header::ORIGIN),
            length: header(header::CONTENT_LENGTH).and_then(|l| l.parse().ok()),
            is_chunked: request.headers().contains_key(header::TRANSFER_ENCODING),
        };
        self.gate.admit(&head, &self.routes)
    }

    async fn body(&self, route: Route, body: Incoming) -> anyhow::Result<Bytes> {
        let most = match route.path {
            MASK => self.gate.mask_bytes,
            _ => MOST_JSON,
        };
        let whole = pin!(Limited::new(body, most).collect());
        let read = timeout(PATIENCE, whole).await;
        let read = read.context("the rest of the request did not come")?;
        Ok(read.map_err(|e| anyhow!(e))?.to_bytes())
    }

    fn route(&self, route: Route, body: &[u8]) -> Answer {
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
            MASK => desk.paint(body.to_vec()).map(|()| Answer::json(json!({}))),
            "view" => parsed::<ViewAsked>(body)
                .and_then(|a| desk.view(&a.edit, a.grid))
                .map(Answer::json),
            "solve" => parsed::<SolveAsked>(body)
                .and_then(|a| desk.solve(&a.edit, &a.lines))
                .map(|found| Answer::json(json!(found))),
            "measure" => parsed::<MeasureAsked>(body)
                .and_then(|a| desk.measure(&a.edit, a.ends, a.length_m))
                .map(|height| Answer::json(json!({"height_m": height}))),
            "save" => parsed::<Edit>(body)
                .and_then(|edit| desk.save(&edit))
                .and_then(|written| Ok((written, desk.state()?)))
                .map(|(written, state)| Answer::json(json!({"written": written, "state": state}))),
            "draft" => parsed::<DraftAsked>(body).and_then(|a| {
                let samples = a.samples.clamp(1, MOST_SAMPLES);
                desk.draft(&a.edit, samples, a.tab).map(Answer::picture)
            }),
            "relight" => parsed::<RelightAsked>(body)
                .and_then(|a| desk.relight(&a.edit, a.tab).map(Answer::picture)),
            other => Err(anyhow!("{other} is not answered")),
        };
        answer.unwrap_or_else(|e| Answer::error(&e))
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
    /// A number that the tab drew.
    #[serde(default)]
    tab: u32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RelightAsked {
    edit: Edit,
    /// A number that the tab drew.
    #[serde(default)]
    tab: u32,
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

    fn picture(picture: Result<Option<Crop>, Superseded>) -> Self {
        match picture {
            Err(Superseded) => {
                Self::new(409, "text/plain", b"a newer picture was asked for".to_vec())
            }
            Ok(None) => Self::new(204, "text/plain", Vec::new()),
            Ok(Some(crop)) => {
                let about = json!({"place": crop.place, "light": crop.light});
                Self {
                    about: Some(about.to_string()),
                    ..Self::new(200, "image/png", crop.png)
                }
            }
        }
    }

    fn error(error: &anyhow::Error) -> Self {
        let text = json!({"error": describe(error)}).to_string();
        Self::new(422, "application/json", text.into_bytes())
    }

    fn refusal(refusal: &Refusal) -> Self {
        let text = format!("{refusal}\n").into_bytes();
        Self::new(refusal.status, "text/plain; charset=utf-8", text)
    }

    fn response(self) -> Response<Full<Bytes>> {
        let mut response = Response::new(Full::new(Bytes::from(self.body)));
        *response.status_mut() =
            StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let headers = response.headers_mut();
        for (name, value) in [
            (header::CONTENT_TYPE, self.kind),
            (header::CONTENT_SECURITY_POLICY, POLICY),
            (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (header::REFERRER_POLICY, "no-referrer"),
            (header::CACHE_CONTROL, "no-store"),
            (
                HeaderName::from_static("cross-origin-resource-policy"),
                "same-origin",
            ),
            (
                HeaderName::from_static("cross-origin-opener-policy"),
                "same-origin",
            ),
        ] {
            headers.insert(name, HeaderValue::from_static(value));
        }
        // A value with control characters is left out: it must not end the header.
        let about = self.about.and_then(|a| HeaderValue::try_from(a).ok());
        if let Some(about) = about {
            headers.insert("x-draft", about);
        }
        response
    }
}
