//! Metrics of an engine for Prometheus, served over HTTP.

use std::fmt::Write as _;
use std::net::SocketAddr;
use std::thread;

use endless_gym_service::{EngineStatus, GroupStatus, Namespace};
use tiny_http::{Header, Method, Request, Response, Server};

use super::failure::Failure;

/// Prometheus' text format.
const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// A metrics server that is bound to its address.
pub struct Metrics {
    server: Server,
}

impl Metrics {
    /// Binds the address.
    pub fn bind(address: SocketAddr) -> Result<Self, Failure> {
        let server = Server::http(address).map_err(|error| format!("--metrics {address}: {error}"))?;
        Ok(Metrics { server })
    }

    /// Where the metrics are.
    pub fn url(&self) -> String {
        format!("http://{}/metrics", self.server.server_addr())
    }

    /// Answers requests in a thread, from the engine's published status, so that a slow client delays neither the
    /// engine nor the end of the process.
    pub fn start(self, namespace: Namespace, service: &str) -> Result<(), Failure> {
        let service = service.to_owned();
        thread::Builder::new().name("metrics".to_owned()).spawn(move || {
            for request in self.server.incoming_requests() {
                let (namespace, service) = (namespace.clone(), service.clone());
                // Each request has its own thread, since writing to a client that does not read blocks. tiny_http also
                // has one for each connection.
                let answer = thread::Builder::new().spawn(move || answer(request, &namespace, &service));
                if let Err(error) = answer {
                    tracing::warn!(%error, "cannot answer a request for metrics");
                }
            }
        })?;
        Ok(())
    }
}

fn answer(request: Request, namespace: &Namespace, service: &str) {
    let is_metrics = request.url().split('?').next() == Some("/metrics");
    let (status, body) = match request.method() {
        Method::Get | Method::Head if is_metrics => match EngineStatus::of(namespace, service) {
            Some(status) => (200, text(&status)),
            None => (503, "the engine's status cannot be read\n".to_owned()),
        },
        Method::Get | Method::Head => (404, "metrics are at /metrics\n".to_owned()),
        _ => (405, "metrics are read with GET\n".to_owned()),
    };
    let mut response = Response::from_string(body).with_status_code(status);
    if let Ok(header) = Header::from_bytes("Content-Type", CONTENT_TYPE) {
        response.add_header(header);
    }
    if let Err(error) = request.respond(response) {
        tracing::debug!(%error, "a client of the metrics has left");
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
