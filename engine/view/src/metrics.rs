//! Metrics of an engine for Prometheus, served over HTTP.

use std::fmt::Write as _;
use std::future;
use std::io;
use std::net::SocketAddr;

use axum::Router;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use endless_gym_page::ServerError;
use endless_gym_page::server::Port;
use endless_gym_service::{EngineStatus, GroupStatus, Namespace};

/// Prometheus' text format.
const TEXT_FORMAT: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Serves the metrics of an engine at `/metrics`, from the status that it publishes.
#[derive(Debug)]
pub struct MetricsServer {
    port: Port,
}

impl MetricsServer {
    /// Binds the address; port 0 for any free one. If the address is of this host only, requests must name it.
    ///
    /// # Errors
    ///
    /// The operating system's, such as that the port is taken.
    pub fn bind(address: SocketAddr) -> io::Result<Self> {
        Ok(MetricsServer { port: Port::bind(address)? })
    }

    /// Where the metrics are.
    pub fn url(&self) -> String {
        format!("{}metrics", self.port.url())
    }

    /// Serves until the process ends.
    ///
    /// # Errors
    ///
    /// [`ServerError::Server`] if the operating system refuses threads or descriptors.
    pub fn run(self, namespace: Namespace, service: String) -> Result<(), ServerError> {
        let metrics = move || future::ready(answer(&namespace, &service));
        let router = Router::new()
            .route("/metrics", get(metrics))
            .fallback(|| future::ready((StatusCode::NOT_FOUND, "metrics are at /metrics\n")));
        self.port.serve(router, future::pending())
    }
}

fn answer(namespace: &Namespace, service: &str) -> Response {
    match EngineStatus::of(namespace, service) {
        Some(status) => ([(CONTENT_TYPE, TEXT_FORMAT)], text(&status)).into_response(),
        None => (StatusCode::SERVICE_UNAVAILABLE, "the engine's status cannot be read\n").into_response(),
    }
}

/// A metric of a group: name, type, help, value.
type GroupMetric = (&'static str, &'static str, &'static str, fn(&GroupStatus) -> f64);

const GROUP_METRICS: [GroupMetric; 12] = [
    ("step", "gauge", "Batches returned, including those before the checkpoint that the engine resumed from.", |g| {
        g.step as f64
    }),
    ("batches_total", "counter", "Batches sent, including those of resets.", |g| g.batches as f64),
    ("env_steps_total", "counter", "Steps, summed over the environments.", |g| g.env_steps as f64),
    ("episodes_total", "counter", "Episodes that have ended.", |g| g.episodes as f64),
    ("rejected_total", "counter", "Requests that were rejected.", |g| g.rejected as f64),
    ("undelivered_total", "counter", "Batches that no process received.", |g| g.undelivered as f64),
    ("trainers_total", "counter", "Trainers that sent requests.", |g| g.trainers as f64),
    ("observer_held_batches", "gauge", "Batches that the observers held when they received their last ones.", |g| {
        g.held_by_observers() as f64
    }),
    ("held_batches", "gauge", "Batches that the trainer held at its last request.", |g| f64::from(g.held)),
    ("pending_requests", "gauge", "Requests that were taken and not answered.", |g| {
        f64::from(u8::from(g.busy.is_some()))
    }),
    ("busy_seconds", "gauge", "Time that the current request has been running; 0 if there is none.", |g| {
        g.busy.unwrap_or_default().as_secs_f64()
    }),
    ("seconds_since_request", "gauge", "Time since the last request; NaN before the first.", |g| {
        g.last_request.map_or(f64::NAN, |since| since.as_secs_f64())
    }),
];

/// A metric of the engine: name, type, help, value.
type EngineMetric = (&'static str, &'static str, &'static str, fn(&EngineStatus) -> f64);

const ENGINE_METRICS: [EngineMetric; 5] = [
    ("uptime_seconds", "gauge", "Time since the engine started.", |e| e.uptime.as_secs_f64()),
    ("dropped_total", "counter", "Requests for an earlier incarnation, which were ignored.", |e| e.dropped as f64),
    ("recoveries_total", "counter", "Dead processes whose resources the engine removed.", |e| e.recoveries as f64),
    ("checkpoints_total", "counter", "Checkpoints saved.", |e| e.checkpoints as f64),
    ("seconds_since_checkpoint", "gauge", "Time since the last checkpoint; NaN before the first.", |e| {
        e.last_checkpoint.map_or(f64::NAN, |since| since.as_secs_f64())
    }),
];

/// The metrics in Prometheus' text format. Names of engines and ids need no escapes.
fn text(status: &EngineStatus) -> String {
    let mut text = String::new();
    let service = &status.service;
    let mut metric = |name: &str, kind: &str, help: &str, values: &mut dyn Iterator<Item = (String, f64)>| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "# HELP endless_gym_{name} {help}\n# TYPE endless_gym_{name} {kind}");
        for (labels, value) in values {
            let _ = writeln!(text, "endless_gym_{name}{{service=\"{service}\"{labels}}} {value}");
        }
    };
    let (id, num_envs, process) = (&status.id, status.num_envs, status.process);
    let labels = format!(
        ",id=\"{id}\",num_envs=\"{num_envs}\",process=\"{process}\",incarnation=\"{:016x}\"",
        status.incarnation
    );
    metric("engine_info", "gauge", "The engine.", &mut std::iter::once((labels, 1.0)));
    for (name, kind, help, value) in ENGINE_METRICS {
        metric(name, kind, help, &mut std::iter::once((String::new(), value(status))));
    }
    for (name, kind, help, value) in GROUP_METRICS {
        let groups = status.groups.iter().enumerate();
        metric(name, kind, help, &mut groups.map(|(number, group)| (format!(",group=\"{number}\""), value(group))));
    }
    text
}
