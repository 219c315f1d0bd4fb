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
        let options = json!({"args": ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1200,900",
            "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"]});
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

    /// Left, top, width and height of an element that is brought into view.
    fn place(&self, id: &str) -> [f64; 4] {
        let find = format!(
            "const e = document.getElementById('{id}'); e.scrollIntoView({{block: 'center'}}); \
            const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]"
        );
        let found = self.script(&find);
        [0, 1, 2, 3].map(|k| found[k].as_f64().unwrap())
    }

    /// Presses the pointer at a place of an element, shares of its size, and drags it to another.
    fn drag(&self, id: &str, from: [f64; 2], to: [f64; 2]) {
        let mut steps = way(self.place(id), from, to);
        steps.insert(1, json!({"type": "pointerDown", "button": 0}));
        steps.push(json!({"type": "pointerUp", "button": 0}));
        let pointer = json!({"type": "pointer", "id": "mouse", "actions": steps});
        self.post("actions", &json!({"actions": [pointer]}));
    }

    /// Drags a finger over an element; a second one comes down half-way, moves as far, and is lifted first.
    fn two_fingers(&self, id: &str, [one, two]: [[[f64; 2]; 2]; 2]) {
        let place = self.place(id);
        let down = || json!({"type": "pointerDown", "button": 0});
        let up = || json!({"type": "pointerUp", "button": 0});
        let pause = || json!({"type": "pause"});
        let mut first = way(place, one[0], one[1]);
        first.insert(1, down());
        let mut second = way(place, two[0], two[1]);
        second.insert(1, down());
        second.push(up());
        // Each list holds a step a tick.
        first.extend((0..7).map(|_| pause()));
        first.push(up());
        second.splice(0..0, (0..6).map(|_| pause()));
        let finger = |id: &str, steps: &[Value]| json!({"type": "pointer", "id": id, "parameters": {"pointerType": "touch"}, "actions": steps});
        let fingers = [finger("one", &first), finger("two", &second)];
        self.post("actions", &json!({"actions": fingers}));
    }

    /// Types keys, one after the other, with nothing between them.
    fn keys(&self, keys: &str) {
        let press = |key: char| {
            let key = key.to_string();
            ["keyDown", "keyUp"].map(|t| json!({"type": t, "value": key}))
        };
        let steps: Vec<Value> = keys.chars().flat_map(press).collect();
        let keyboard = json!({"type": "key", "id": "keyboard", "actions": steps});
        self.post("actions", &json!({"actions": [keyboard]}));
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

/// The pointer on its way between two shares of a rectangle.
fn way([x, y, w, h]: [f64; 4], from: [f64; 2], to: [f64; 2]) -> Vec<Value> {
    let step = |k: u32| {
        let t = f64::from(k) / 10.0;
        let at = [0, 1].map(|k| from[k] + t * (to[k] - from[k]));
        let (x, y) = (
            (x + w * at[0]).round() as i64,
            (y + h * at[1]).round() as i64,
        );
        json!({"type": "pointerMove", "duration": 30, "x": x, "y": y})
    };
    (0..=10).map(step).collect()
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

/// A project, its page, the page's address, and a browser that shows it.
fn opened() -> (Project, Stopped, String, Browser) {
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
    let mut command = project.command(DIPIR, &["place", "place.toml", "--no-open", "--json"]);
    command.stderr(Stdio::inherit());
    let (server, line) = start(command, "http://");
    let address = line.split('"').find(|part| part.starts_with("http://"));
    let address = address.expect("an address").to_owned();
    let browser = Browser::new();
    browser.post("url", &json!({"url": address}));
    browser.wait("document.documentElement.dataset.ready");
    browser.wait("document.getElementById('origin').textContent");
    (project, server, address, browser)
}

const SAVED: &str = "document.getElementById('status').textContent.startsWith('Wrote ')";

#[test]
#[ignore = "needs ChromeDriver and Chromium"]
fn what_is_placed_on_the_page_is_what_the_run_makes() {
    let (project, _server, _, browser) = opened();
    let before = String::from_utf8(project.read("place.toml")).unwrap();
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
    browser.wait(SAVED);
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

#[test]
#[ignore = "needs ChromeDriver and Chromium"]
fn hasty_hands_two_fingers_two_tabs_and_a_server_that_ends_lose_nothing() {
    let (project, server, address, browser) = opened();
    let says = |id: &str, text: &str| {
        let text = json!(text);
        browser.wait(&format!(
            "document.getElementById('{id}').textContent.includes({text})"
        ));
    };
    let shows = |id: &str, number: f64| {
        browser.wait(&format!(
            "document.getElementById('{id}').value === '{number}'"
        ));
    };
    let file = || String::from_utf8(project.read("place.toml")).unwrap();

    // Keys that come faster than answers all count, and are undone as one.
    browser.click("#canvas");
    browser.script("document.getElementById('canvas').focus()");
    browser.keys("qqqq");
    shows("yaw", 20.0);
    browser.click("#undo");
    shows("yaw", 0.0);

    // A number that cannot be gives way to the one before it, and it is said why.
    browser.script(
        "const f = document.getElementById('yaw'); f.value = 1e9; f.dispatchEvent(new Event('change'))",
    );
    says("status", "no usable number");
    shows("yaw", 0.0);
    browser.keys("q");
    shows("yaw", 5.0);
    browser.click("#undo");
    shows("yaw", 0.0);

    // A copy is chosen by the keyboard, which stays in the list.
    browser.keys("c");
    browser.wait("document.querySelectorAll('#objects input').length === 2");
    browser.script("document.querySelector('#objects input').focus()");
    let chosen = "document.activeElement === document.querySelectorAll('#objects input')[1]";
    browser.keys("\u{E014}");
    browser.wait(&format!("{chosen} && document.activeElement.checked"));
    browser.script("document.getElementById('canvas').focus()");
    browser.keys("\u{E017}");
    browser.wait("document.querySelectorAll('#objects input').length === 1");

    // A second finger sizes what the first one drags; both are one change.
    let place = browser.text("where");
    let fingers = [[[0.5, 0.6], [0.5, 0.62]], [[0.6, 0.62], [0.8, 0.62]]];
    browser.two_fingers("canvas", fingers);
    // 1.6 m before; the fingers are about .1 apart at first, and .3 at last.
    browser.wait("document.getElementById('height').valueAsNumber > 3.2");
    browser.click("#undo");
    says("where", &place);

    // What is typed is saved, once, however long the keys are held.
    let hold = "const f = document.getElementById('height'); f.focus(); f.value = 2; \
        f.dispatchEvent(new Event('input', {bubbles: true})); \
        for (let k = 0; k < 9; k += 1) f.dispatchEvent(new KeyboardEvent('keydown', \
        {key: 's', ctrlKey: true, repeat: k > 0, bubbles: true, cancelable: true}))";

    // Another tab has read the same file.
    let first = browser.ask("GET", &format!("{}/window", browser.session), &json!({}));
    let second = browser.post("window/new", &json!({"type": "tab"}));
    let go = |handle: &Value| browser.post("window", &json!({"handle": handle}));
    go(&second["handle"]);
    browser.post("url", &json!({"url": address}));
    browser.wait("document.documentElement.dataset.ready");
    browser.script("document.getElementById('canvas').focus()");
    browser.keys("+++");
    go(&first);
    browser.script(hold);
    browser.wait(SAVED);
    assert_eq!(browser.count("save"), 1);
    let saved = file();
    assert!(saved.contains("height_m = 2.0\n"), "{saved}");
    go(&second["handle"]);
    browser.click("#save");
    says("status", "reload the page");
    assert_eq!(file(), saved);

    // The server ends while pages are open.
    go(&first);
    drop(server);
    browser.script("document.getElementById('canvas').focus()");
    browser.keys("e");
    says("status", "does not answer");
    browser.screenshot("ended.png");
    assert_eq!(file(), saved);
}

/// Levels of 255, over the picture at the size of the page's.
fn rmse(shown: &RgbImage, other: &RgbImage) -> f64 {
    let other = resize(other, shown.width(), shown.height(), FilterType::Triangle);
    let pairs = shown.iter().zip(other.iter());
    let sum: f64 = pairs.map(|(&a, &b)| f64::from(a.abs_diff(b)).powi(2)).sum();
    (sum / shown.len() as f64).sqrt()
}
