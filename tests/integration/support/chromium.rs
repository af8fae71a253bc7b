//! A headless Chromium, controlled over pipes with the DevTools protocol.
#![allow(dead_code)] // Some functions are only used by the tests of bindings/web.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value as Json, json};

/// How long a condition may take; the machine may be busy with other tests.
const PATIENCE: Duration = Duration::from_secs(120);

/// Names of Chromium's program, unless the environment variable CHROMIUM names one. `cargo xtask` looks for the same.
const PROGRAMS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];

/// A host name that resolves to this machine, as in a DNS rebinding attack.
pub const REBOUND: &str = "rebound.test";

/// A browser with one tab.
pub struct Chromium {
    process: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    calls: u64,
    session: Option<String>,
    /// The page's errors: exceptions, console errors, and files that could not be loaded. There must be none when the browser
    /// closes, so a test that provokes errors clears them.
    pub complaints: Vec<String>,
    /// The folder with the profile and the downloads.
    folder: PathBuf,
}

impl Chromium {
    /// Starts a browser whose files are in `folder`, with a window of that size.
    pub fn start(folder: &Path, (width, height): (u32, u32)) -> Self {
        let _ = std::fs::remove_dir_all(folder);
        std::fs::create_dir_all(folder.join("downloads")).unwrap();
        // Chromium reads commands from descriptor 3 and writes answers to descriptor 4.
        let mut command = Command::new("sh");
        command.args(["-c", r#"exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null"#, &program()]);
        // No sandbox: it loads only the page under test, and not every container permits a sandbox.
        command.args(["--headless=new", "--remote-debugging-pipe", "--no-sandbox", "--disable-gpu", "--no-first-run"]);
        command.args(["--disable-background-networking", "--disable-dev-shm-usage", "--disable-extensions"]);
        command.arg(format!("--host-resolver-rules=MAP {REBOUND} 127.0.0.1"));
        command.arg(format!("--user-data-dir={}", folder.join("profile").display()));
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut process = command.spawn().expect("Chromium starts");
        let (to, from) = (process.stdin.take().unwrap(), BufReader::new(process.stdout.take().unwrap()));
        let folder = folder.to_owned();
        let mut chromium = Chromium { process, to, from, calls: 0, session: None, complaints: Vec::new(), folder };
        let tab = chromium.call("Target.createTarget", &json!({"url": "about:blank"}));
        let attach = json!({"targetId": tab["targetId"], "flatten": true});
        let session = chromium.call("Target.attachToTarget", &attach)["sessionId"].as_str().map(str::to_owned);
        let downloads = json!({"behavior": "allow", "downloadPath": chromium.folder.join("downloads")});
        chromium.call("Browser.setDownloadBehavior", &downloads);
        chromium.session = session;
        for domain in ["Page", "Runtime", "Log", "DOM"] {
            chromium.call(&format!("{domain}.enable"), &json!({}));
        }
        chromium.resize(width, height, false);
        chromium
    }

    /// Resizes the window. A phone has a touch screen.
    pub fn resize(&mut self, width: u32, height: u32, phone: bool) {
        let metrics = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone});
        self.call("Emulation.setDeviceMetricsOverride", &metrics);
        self.call("Emulation.setTouchEmulationEnabled", &json!({"enabled": phone}));
    }

    /// Loads a page.
    pub fn load(&mut self, url: &str) {
        let answer = self.call("Page.navigate", &json!({"url": url}));
        assert!(answer["errorText"].is_null(), "{url}: {}", answer["errorText"]);
    }

    /// Loads the page again, and waits until it is there: Chromium may never answer what a page is asked while it leaves.
    pub fn reload(&mut self) {
        self.call("Page.reload", &json!({}));
        self.read_until(|event| event["method"] == "Page.loadEventFired");
    }

    /// The value of an expression in the page. Waits if it is a promise.
    pub fn value(&mut self, expression: &str) -> Json {
        let arguments = json!({"expression": expression, "awaitPromise": true, "returnByValue": true});
        let answer = self.call("Runtime.evaluate", &arguments);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {}", answer["exceptionDetails"]);
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is true. Until then it may fail, for example while a page is loading.
    pub fn wait(&mut self, expression: &str) {
        let start = Instant::now();
        loop {
            let arguments = json!({"expression": format!("!!({expression})"), "returnByValue": true});
            let answer = self.call("Runtime.evaluate", &arguments);
            if answer["result"]["value"] == true {
                return;
            }
            if start.elapsed() >= PATIENCE {
                let page = "[location.href, document.readyState, document.body?.innerText].join()";
                let page = self.call("Runtime.evaluate", &json!({"expression": page, "returnByValue": true}));
                panic!("{expression} is not true: {answer}; {page}; {:?}", self.complaints);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Presses and releases a key, named by its code.
    pub fn press(&mut self, code: &str) {
        self.key("rawKeyDown", code);
        self.key("keyUp", code);
    }

    /// Presses Enter as a keyboard does, which also submits a form or changes a field.
    pub fn enter(&mut self) {
        for kind in ["keyDown", "keyUp"] {
            let event =
                json!({"type": kind, "code": "Enter", "key": "Enter", "text": "\r", "windowsVirtualKeyCode": 13});
            self.call("Input.dispatchKeyEvent", &event);
        }
    }

    /// Sends a `rawKeyDown` or `keyUp`.
    pub fn key(&mut self, kind: &str, code: &str) {
        self.call("Input.dispatchKeyEvent", &json!({"type": kind, "code": code, "key": code}));
    }

    /// The middle of an element, which it scrolls into view if it is not.
    fn middle(&mut self, selector: &str) -> Json {
        self.value(&format!(
            "(() => {{ const e = document.querySelector({}); e.scrollIntoView({{block: 'nearest', behavior: 'instant'}}); \
             const b = e.getBoundingClientRect(); return {{x: b.x + b.width / 2, y: b.y + b.height / 2}} }})()",
            json!(selector)
        ))
    }

    /// Clicks the middle of an element with the mouse.
    pub fn click(&mut self, selector: &str) {
        let mut event = self.middle(selector);
        (event["button"], event["clickCount"]) = (json!("left"), json!(1));
        for kind in ["mousePressed", "mouseReleased"] {
            event["type"] = json!(kind);
            self.call("Input.dispatchMouseEvent", &event);
        }
    }

    /// Sends a `touchStart` or `touchEnd` in the middle of an element.
    pub fn touch(&mut self, kind: &str, selector: &str) {
        let point = self.middle(selector);
        let points = if kind == "touchStart" { json!([point]) } else { json!([]) };
        self.call("Input.dispatchTouchEvent", &json!({"type": kind, "touchPoints": points}));
    }

    /// Chooses a file in a file input of the page.
    pub fn choose(&mut self, selector: &str, file: &Path) {
        let root = self.call("DOM.getDocument", &json!({}))["root"]["nodeId"].clone();
        let field = self.call("DOM.querySelector", &json!({"nodeId": root, "selector": selector}))["nodeId"].clone();
        self.call("DOM.setFileInputFiles", &json!({"nodeId": field, "files": [file]}));
    }

    /// Waits for the file that the page saves.
    pub fn download(&mut self) -> PathBuf {
        let start = Instant::now();
        loop {
            let files = std::fs::read_dir(self.folder.join("downloads")).unwrap().map(|entry| entry.unwrap().path());
            if let Some(file) = files.into_iter().find(|path| path.extension().is_some_and(|ending| ending == "gz")) {
                return file;
            }
            assert!(start.elapsed() < PATIENCE, "nothing was saved");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Calls a method and waits for its answer.
    pub fn call(&mut self, method: &str, arguments: &Json) -> Json {
        self.calls += 1;
        let mut message = json!({"id": self.calls, "method": method, "params": arguments});
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.to.write_all(format!("{message}\0").as_bytes()).expect("Chromium listens");
        let answer = self.read_until(|answer| answer["id"] == message["id"]);
        assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
        answer["result"].clone()
    }

    /// Reads messages until that one.
    fn read_until(&mut self, is_it: impl Fn(&Json) -> bool) -> Json {
        loop {
            let mut bytes = Vec::new();
            self.from.read_until(0, &mut bytes).expect("Chromium answers");
            assert_eq!(bytes.pop(), Some(0), "Chromium ended");
            let answer: Json = serde_json::from_slice(&bytes).expect("Chromium answers with JSON");
            if is_it(&answer) {
                return answer;
            }
            self.note(&answer);
        }
    }

    fn note(&mut self, event: &Json) {
        let of = &event["params"];
        match event["method"].as_str().unwrap_or_default() {
            "Runtime.exceptionThrown" => self.complaints.push(of["exceptionDetails"].to_string()),
            "Runtime.consoleAPICalled" if of["type"] == "error" => self.complaints.push(of["args"].to_string()),
            "Log.entryAdded" if of["entry"]["level"] == "error" => self.complaints.push(of["entry"].to_string()),
            _ => {}
        }
    }
}

impl Drop for Chromium {
    fn drop(&mut self) {
        // A browser that is killed leaves a folder in /tmp.
        let _ = self.to.write_all(b"{\"id\":0,\"method\":\"Browser.close\"}\0");
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(10) && matches!(self.process.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(10));
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
        let _ = std::fs::remove_dir_all(&self.folder);
        if !std::thread::panicking() {
            assert_eq!(self.complaints, Vec::<String>::new());
        }
    }
}

fn program() -> String {
    let starts = |name: &str| {
        let version = Command::new(name).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        version.is_ok_and(|status| status.success())
    };
    std::env::var("CHROMIUM").unwrap_or_else(|_| {
        PROGRAMS.iter().find(|name| starts(name)).unwrap_or_else(|| panic!("none of {PROGRAMS:?} is there")).to_string()
    })
}
