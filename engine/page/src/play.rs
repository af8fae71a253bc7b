//! The server of the page that plays the environments.

use std::sync::atomic::AtomicBool;

use axum::Router;
use axum::http::{HeaderMap, Method, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use form_urlencoded::Serializer;
use serde_json::{Map, Value as Json};

use crate::error::ServerError;
use crate::files;
use crate::server::{self, Port};

/// A service worker that replaces and unregisters one installed earlier at this address. The page's own worker caches
/// the page for offline use, which is useless with a local server and would outlive the program.
const WORKER: &str = "addEventListener('install', () => skipWaiting());\n\
                      addEventListener('activate', () => registration.unregister());\n";

/// Serves the page that plays the environments on 127.0.0.1.
///
/// ```no_run
/// use std::sync::atomic::AtomicBool;
///
/// use endless_gym_page::PlayServer;
///
/// let server = PlayServer::bind(0, "MysteryPath-v0")?;
/// println!("{}", server.url("MysteryPath-v0", &serde_json::Map::new(), Some(7)));
/// server.run(&AtomicBool::new(false))?;
/// # Ok::<(), endless_gym_page::ServerError>(())
/// ```
#[derive(Debug)]
pub struct PlayServer {
    port: Port,
}

impl PlayServer {
    /// Binds the port, 0 for any free one, to play an environment.
    ///
    /// # Errors
    ///
    /// [`ServerError::PageNotBuilt`] if this program was built without the page, [`ServerError::NotOnPage`] if its page does not have the
    /// environment, and [`ServerError::Port`] if the port is taken.
    pub fn bind(port: u16, id: &str) -> Result<Self, ServerError> {
        let engines: Vec<_> = files::ENGINES.into_iter().filter_map(files::file).map(files::decompress).collect();
        check(&engines, id)?;
        Ok(PlayServer { port: Port::local(port)? })
    }

    /// The address of an episode: an environment with reset parameters and a seed, or a random seed for `None`.
    pub fn url(&self, id: &str, options: &Map<String, Json>, seed: Option<u64>) -> String {
        let suite = if id.starts_with("popgym-") { "?popgym" } else { "" };
        format!("{}{suite}#{}", self.port.url(), link(id, options, seed))
    }

    /// Serves until the flag is set.
    ///
    /// # Errors
    ///
    /// [`ServerError::Server`] if the operating system refuses threads or descriptors.
    pub fn run(self, stop: &AtomicBool) -> Result<(), ServerError> {
        self.port.serve(Router::new().fallback(answer), server::is_set(stop))
    }
}

/// Checks that one of the page's engines has an environment.
fn check(engines: &[Vec<u8>], id: &str) -> Result<(), ServerError> {
    if engines.is_empty() {
        return Err(ServerError::PageNotBuilt);
    }
    // An engine without the text of the id cannot have the environment.
    let is_on_page = engines.iter().any(|engine| engine.windows(id.len().max(1)).any(|part| part == id.as_bytes()));
    is_on_page.then_some(()).ok_or_else(|| ServerError::NotOnPage { id: id.to_owned() })
}

async fn answer(method: Method, headers: HeaderMap, address: Uri) -> Response {
    if !matches!(method, Method::GET | Method::HEAD) {
        return (StatusCode::METHOD_NOT_ALLOWED, "the page is read with GET\n").into_response();
    }
    match address.path() {
        "/" => found(&headers, "index.html"),
        "/worker.js" => server::file("worker.js", WORKER.as_bytes()),
        path => found(&headers, path.strip_prefix('/').unwrap_or_default()),
    }
}

fn found(headers: &HeaderMap, name: &str) -> Response {
    let file = files::file(name);
    file.map_or_else(server::not_found, |bytes| server::compressed(headers, name, bytes))
}

/// The part after `#` in the address of an episode, as the page's `link.js` reads it. Reset parameters are JSON, but
/// text that is not valid JSON is written without quotes.
fn link(id: &str, options: &Map<String, Json>, seed: Option<u64>) -> String {
    let mut fields = Serializer::new(String::new());
    fields.append_pair("env", id);
    if let Some(seed) = seed {
        fields.append_pair("seed", &seed.to_string());
    }
    for (name, value) in options {
        let plain = value.as_str().filter(|text| serde_json::from_str::<Json>(text).is_err());
        fields.append_pair(name, plain.unwrap_or(&value.to_string()));
    }
    fields.finish()
}

#[cfg(test)]
mod tests {
    use axum::http::header::ACCEPT_ENCODING;
    use serde_json::json;

    use super::*;

    fn answered(method: Method, path: &str) -> Response {
        asked(method, HeaderMap::new(), path)
    }

    fn asked(method: Method, headers: HeaderMap, path: &str) -> Response {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(answer(method, headers, path.parse().unwrap()))
    }

    fn body(response: Response) -> Vec<u8> {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(axum::body::to_bytes(response.into_body(), usize::MAX)).unwrap().to_vec()
    }

    #[test]
    fn files_are_sent_compressed_to_clients_that_take_it() {
        for (accepted, is_compressed) in
            [("gzip, deflate, br", true), ("deflate,gzip", true), ("gzip;q=0", false), ("identity", false)]
        {
            let headers = HeaderMap::from_iter([(ACCEPT_ENCODING, accepted.parse().unwrap())]);
            let response = asked(Method::GET, headers, "/style.css");
            assert_eq!(response.headers()["content-type"], "text/css; charset=utf-8");
            assert_eq!(response.headers().get("content-encoding").is_some(), is_compressed, "{accepted}");
            let plain = body(answered(Method::GET, "/style.css"));
            let sent = body(response);
            assert!(plain.starts_with(b"/*"));
            assert!(if is_compressed { sent.len() < plain.len() / 2 } else { sent == plain }, "{accepted}");
        }
    }

    #[test]
    fn the_pages_files_are_served_and_nothing_else() {
        let kind = |response: &Response| response.headers()["content-type"].to_str().unwrap().to_owned();
        for (name, _) in files::FILES {
            assert_eq!(answered(Method::GET, &format!("/{name}")).status(), StatusCode::OK, "{name}");
        }
        assert_eq!(kind(&answered(Method::GET, "/")), "text/html; charset=utf-8");
        assert_eq!(kind(&answered(Method::HEAD, "/app.js")), "text/javascript; charset=utf-8");
        assert_eq!(kind(&server::file("engine.wasm", b"")), "application/wasm");
        for path in
            ["/../Cargo.toml", "/files/../index.html", "/%2e%2e/Cargo.toml", "//index.html", "/index.html/", "/x"]
        {
            assert_eq!(answered(Method::GET, path).status(), StatusCode::NOT_FOUND, "{path}");
        }
        assert_eq!(answered(Method::POST, "/").status(), StatusCode::METHOD_NOT_ALLOWED);
    }

    #[test]
    fn an_environment_that_is_not_on_the_page_is_an_error_that_names_what_works() {
        let engines = [b"\0asm MysteryPath-v0 ".to_vec(), b"\0asm popgym-PendulumEasy-v0 ".to_vec()];
        assert!(["MysteryPath-v0", "popgym-PendulumEasy-v0"].into_iter().all(|id| check(&engines, id).is_ok()));
        for error in [check(&engines, "TMaze-v0"), check(&[], "MysteryPath-v0")] {
            let message = error.unwrap_err().to_string();
            assert!(message.contains("`--terminal`") && message.contains("`endless page --out FOLDER`"), "{message}");
            assert!(!message.contains('\n'));
        }
    }

    #[test]
    fn links_have_the_format_that_the_page_reads() {
        let Json::Object(options) = json!({"num_coins": [3], "agent_visible": true, "name": "a b", "digits": "7"})
        else {
            panic!("an object")
        };
        let found = link("SearingSpotlights-v0", &options, Some(u64::MAX));
        let start = "env=SearingSpotlights-v0&seed=18446744073709551615&";
        assert_eq!(found, format!("{start}num_coins=%5B3%5D&agent_visible=true&name=a+b&digits=%227%22"));
        assert_eq!(link("MysteryPath-v0", &Map::new(), None), "env=MysteryPath-v0");
    }
}
