//! `dipir place` in a browser, driven as a user would. It needs ChromeDriver and Chromium on the PATH, which not every
//! machine has, so it runs when asked for: `cargo test --test executables browser -- --ignored`.
//! `SCREENSHOTS=FOLDER` keeps pictures of the page.
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use dipir_imaging::file::write_png;
use dipir_imaging::raster::{DisplayImage, Raster};
use glam::Vec3;
use image::imageops::{FilterType, resize};
use image::{RgbImage, load_from_memory};
use serde_json::{Value, json};

use crate::project::*;

/// More than any answer takes on a slow machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// A program that is stopped when the test ends, however it ends.
struct Stopped(Child);

impl Drop for Stopped {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts a program and waits for the line on its standard output that holds `mark`.
fn start(mut command: Command, mark: &str) -> (Stopped, String) {
    let mut child = command.spawn().expect("the program starts");
    let out = child.stdout.take().unwrap();
    let child = Stopped(child);
    let mut lines = BufReader::new(out).lines();
    let line = lines.find_map(|line| line.ok().filter(|l| l.contains(mark)));
    // Whatever else is printed is read, so that nobody waits for a full pipe.
    thread::spawn(move || lines.for_each(drop));
    (child, line.unwrap_or_else(|| panic!("no line with {mark}")))
}

/// A browser without a window, by the protocol of W3C WebDriver.
struct Browser {
    port: u16,
    session: String,
    _driver: Stopped,
}

impl Browser {
    fn new() -> Self {
        let mut command = Command::new("chromedriver");
        command.arg("--port=0").stdout(Stdio::piped());
        let (driver, line) = start(command, "successfully on port ");
        let (_, port) = line.rsplit_once("on port ").unwrap();
        let port = port.trim_end_matches('.').parse().unwrap();
        let mut browser = Self {
            port,
            session: String::new(),
            _driver: driver,
        };
        let options = json!({"args": ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1200,900"]});
        let wanted = json!({"capabilities": {"alwaysMatch": {"goog:chromeOptions": options}}});
        let made = browser.ask("POST", "/session", &wanted);
        browser.session = format!("/session/{}", made["sessionId"].as_str().unwrap());
        browser
    }

    fn ask(&self, method: &str, path: &str, body: &Value) -> Value {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let body = body.to_string();
        let (port, length) = (self.port, body.len());
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: {length}\r\n\r\n"
        );
        stream.write_all((head + &body).as_bytes()).unwrap();
        let mut reader = BufReader::new(stream);
        let mut length = 0;
        loop {
            let mut line = String::new();
            reader.read_line(&mut line).unwrap();
            let lower = line.to_ascii_lowercase();
            if let Some(value) = lower.strip_prefix("content-length:") {
                length = value.trim().parse().unwrap();
            }
            if line.trim().is_empty() {
                break;
            }
        }
        let mut bytes = vec![0; length];
        reader.read_exact(&mut bytes).unwrap();
        let answer: Value = serde_json::from_slice(&bytes).unwrap();
        let value = answer["value"].clone();
        assert!(value.get("error").is_none(), "{path}: {value}");
        value
    }

    fn post(&self, path: &str, body: &Value) -> Value {
        self.ask("POST", &format!("{}/{path}", self.session), body)
    }

    /// What a script returns.
    fn script(&self, text: &str) -> Value {
        self.post("execute/sync", &json!({"script": text, "args": []}))
    }

    /// Waits until a script returns true.
    #[track_caller]
    fn wait(&self, condition: &str) {
        let begin = Instant::now();
        while self.script(&format!("return Boolean({condition})")) != json!(true) {
            let status = "return document.getElementById('status')?.textContent";
            let late = begin.elapsed() > PATIENCE;
            assert!(!late, "{condition}; the page says {}", self.script(status));
            thread::sleep(Duration::from_millis(100));
        }
    }

    fn text(&self, id: &str) -> String {
        let text = format!("return document.getElementById('{id}').textContent");
        self.script(&text).as_str().unwrap().to_owned()
    }

    fn click(&self, selector: &str) {
        self.script(&format!("document.querySelector('{selector}').click()"));
    }

    /// Presses the pointer at a place of an element, shares of its size, and drags it to another.
    fn drag(&self, id: &str, from: [f64; 2], to: [f64; 2]) {
        let find = format!(
            "const e = document.getElementById('{id}'); e.scrollIntoView({{block: 'center'}}); \
            const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]"
        );
        let found = self.script(&find);
        let [x, y, w, h] = [0, 1, 2, 3].map(|k| found[k].as_f64().unwrap());
        let steps = (0..=10).map(|k| {
            let t = f64::from(k) / 10.0;
            let at = [0, 1].map(|k| from[k] + t * (to[k] - from[k]));
            let (x, y) = (
                (x + w * at[0]).round() as i64,
                (y + h * at[1]).round() as i64,
            );
            json!({"type": "pointerMove", "duration": 30, "x": x, "y": y})
        });
        let mut steps: Vec<Value> = steps.collect();
        steps.insert(1, json!({"type": "pointerDown", "button": 0}));
        steps.push(json!({"type": "pointerUp", "button": 0}));
        let pointer = json!({"type": "pointer", "id": "mouse", "actions": steps});
        self.post("actions", &json!({"actions": [pointer]}));
    }

    fn count(&self, route: &str) -> u64 {
        let count = self.script(&format!("return {}", answered(route)));
        count.as_u64().unwrap()
    }

    fn screenshot(&self, name: &str) {
        let Some(folder) = std::env::var_os("SCREENSHOTS") else {
            return;
        };
        let shot = self.ask("GET", &format!("{}/screenshot", self.session), &json!({}));
        let bytes = BASE64_STANDARD.decode(shot.as_str().unwrap()).unwrap();
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(std::path::Path::new(&folder).join(name), bytes).unwrap();
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        if !self.session.is_empty() && !thread::panicking() {
            self.ask("DELETE", &self.session, &json!({}));
        }
    }
}

/// How many requests to the server of the page were answered, as a script.
fn answered(route: &str) -> String {
    format!(
        "performance.getEntriesByType('resource')\
         .filter(e => e.name.endsWith('/{route}') && e.responseEnd > 0).length"
    )
}

const WIDTH: usize = 600;
const HEIGHT: usize = 400;

/// A grey square under a blue sky, with a street that leads away.
fn photo() -> DisplayImage {
    let mut picture = Raster::filled(WIDTH, HEIGHT, Vec3::ZERO);
    for (k, pixel) in picture.pixels_mut().iter_mut().enumerate() {
        let (x, y) = ((k % WIDTH) as f32 - 300.0, (k / WIDTH) as f32 - 150.0);
        let street = if x.abs() < 0.6 * y { 0.35 } else { 0.5 };
        *pixel = match y < 0.0 {
            true => Vec3::new(0.45, 0.6, 0.85) - 0.001 * y,
            false => Vec3::splat(street + 0.0002 * x),
        };
    }
    DisplayImage(picture)
}

#[test]
#[ignore = "needs ChromeDriver and Chromium"]
fn what_is_placed_on_the_page_is_what_the_run_makes() {
    let project = Project::new();
    write_png(project.path("photo.png"), &photo()).unwrap();
    let init = [
        "init",
        "photo.png",
        "object.obj",
        "--out",
        "place.toml",
        "--height-m",
        "1.6",
        "--fov",
        "60",
        "--pitch",
        "-8",
    ];
    project.run(DIPIR, &init).expect_success();
    let before = String::from_utf8(project.read("place.toml")).unwrap();
    let mut command = project.command(DIPIR, &["place", "place.toml", "--no-open", "--json"]);
    command.stderr(Stdio::inherit());
    let (_server, line) = start(command, "http://");
    let address = line.split('"').find(|part| part.starts_with("http://"));
    let browser = Browser::new();
    browser.post("url", &json!({"url": address.expect("an address")}));
    browser.wait("document.documentElement.dataset.ready");
    browser.wait("document.getElementById('origin').textContent");
    browser.screenshot("opened.png");

    // The object follows the pointer, wherever it is taken.
    let contact = "return (await fetch('state').then(r => r.json())).view.objects[0].contact";
    let at = browser.script(contact);
    let at = [0, 1].map(|k| at[k].as_f64().unwrap());
    let share = [at[0] / WIDTH as f64, at[1] / HEIGHT as f64 - 0.02];
    let place = browser.text("where");
    browser.drag("canvas", share, [share[0] + 0.12, share[1] + 0.08]);
    browser.wait(&format!(
        "document.getElementById('where').textContent !== {}",
        json!(place)
    ));

    // Lines along the street give the camera.
    browser.click("#tools input[value=lines]");
    for (from, to) in [
        ([0.2, 0.95], [0.27, 0.95]),
        ([0.42, 0.6], [0.4, 0.625]),
        ([0.8, 0.95], [0.73, 0.95]),
        ([0.58, 0.6], [0.6, 0.625]),
    ] {
        browser.drag("canvas", from, to);
    }
    browser.wait("document.getElementById('solved').textContent.startsWith('pitch ')");
    browser.screenshot("lines.png");
    let camera = browser.text("camera");
    browser.click("#use-lines");
    browser.wait(&format!(
        "document.getElementById('camera').textContent !== {}",
        json!(camera)
    ));
    // The street meets the sky 50 pixels above the middle: 5.5 degrees at a focal length of 520 pixels.
    let camera = browser.text("camera");
    assert!(camera.contains("looks 5.5° down"), "{camera}");
    browser.click("#tools input[value=move]");

    // The sun turns with the dial, and the picture with it.
    browser.wait(&format!("{} > 0", answered("relight")));
    let [lit, drafts] = ["relight", "draft"].map(|route| browser.count(route));
    browser.drag("dial", [0.5, 0.3], [0.75, 0.4]);
    let azimuth = "return document.getElementById('azimuth').valueAsNumber";
    let turned = browser.script(azimuth).as_f64().unwrap();
    assert!((45.0..90.0).contains(&turned), "{turned}");
    browser.wait(&format!("{} > {lit}", answered("relight")));
    assert!(
        browser.count("draft") < drafts + 2,
        "no picture while the sun turned"
    );

    // A fine picture follows; the grid and the frame of the object are hidden.
    browser.wait("document.getElementById('canvas').dataset.samples === '32'");
    browser.click("#show");
    browser.screenshot("turned.png");
    browser.post("window/rect", &json!({"width": 500, "height": 900}));
    browser.screenshot("telephone.png");
    browser.post("window/rect", &json!({"width": 1200, "height": 900}));
    browser.click("#tools input[value=mask]");
    thread::sleep(Duration::from_millis(300));
    let shown = browser.script("return document.getElementById('canvas').toDataURL('image/png')");
    let (_, shown) = shown.as_str().unwrap().split_once(',').unwrap();
    let shown = load_from_memory(&BASE64_STANDARD.decode(shown).unwrap())
        .unwrap()
        .to_rgb8();

    browser.click("#save");
    browser.wait("document.getElementById('status').textContent.startsWith('Wrote ')");
    let after = String::from_utf8(project.read("place.toml")).unwrap();
    assert!(after.contains("azimuth_deg") && after != before, "{after}");
    for comment in before.lines().filter(|l| l.starts_with('#')) {
        assert!(after.contains(comment), "{comment}");
    }

    project
        .run(DIPIR, &["run", "place.toml", "-q", "--draft"])
        .expect_success();
    let run = load_from_memory(&project.read("out-place/composite/composite.png"))
        .unwrap()
        .to_rgb8();
    let bare = load_from_memory(&project.read("photo.png"))
        .unwrap()
        .to_rgb8();
    let [changed, off] = [rmse(&shown, &bare), rmse(&shown, &run)];
    assert!(changed > 6.0, "the page shows hardly an object: {changed}");
    // .12 was measured: the grain of two drafts, and edges that the page scales. An object elsewhere makes 1 or more.
    assert!(off < 0.2 * changed, "{off} of {changed} levels");
}

/// Levels of 255, over the picture at the size of the page's.
fn rmse(shown: &RgbImage, other: &RgbImage) -> f64 {
    let other = resize(other, shown.width(), shown.height(), FilterType::Triangle);
    let pairs = shown.iter().zip(other.iter());
    let sum: f64 = pairs.map(|(&a, &b)| f64::from(a.abs_diff(b)).powi(2)).sum();
    (sum / shown.len() as f64).sqrt()
}
