//! Logs of a run: one line per update on standard output, `progress.jsonl`, and TensorBoard's events.

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use endless_gym_core::{files, printable};
use serde_json::{Map, Value as Json};

use crate::error::{Error, file};
use crate::rollout::Clock;

/// Log file in the folder of a run, with one JSON object per update.
pub(crate) const PROGRESS: &str = "progress.jsonl";

/// Writes the metrics of each update.
pub struct Logger {
    path: PathBuf,
    progress: File,
    events: Events,
    updates: u64,
    /// Seconds of the last updates, at most 20.
    recent: VecDeque<f64>,
}

impl Logger {
    /// Opens the logs of a run of so many updates, of which `update` are done. What follows their rows is cut off: rows of later updates,
    /// and the part of a row that a killed process wrote. Fails with [`Error::File`], and [`Error::Progress`] if a row
    /// of these updates is missing.
    pub fn open(run: &Path, updates: u64, update: u64) -> Result<Self, Error> {
        let path = run.join(PROGRESS);
        let text = if path.exists() { files::read(&path).map_err(file(&path))? } else { Vec::new() };
        let mut lines = text.split_inclusive(|byte| *byte == b'\n');
        let mut length = 0;
        for number in 1..=update {
            let line = lines.next().filter(|line| line.ends_with(b"\n")).unwrap_or_default();
            let row: Option<Json> = serde_json::from_slice(line).ok();
            if row.is_none_or(|row| row["update"] != number) {
                return Err(Error::Progress { run: run.to_owned(), update, missing: number });
            }
            length += line.len() as u64;
        }
        let progress = OpenOptions::new().append(true).create(true).open(&path).map_err(file(&path))?;
        progress.set_len(length).map_err(file(&path))?;
        Ok(Logger { path, progress, events: Events::create(run)?, updates, recent: VecDeque::new() })
    }

    /// Logs one update.
    pub fn update(
        &mut self,
        update: u64,
        steps: u64,
        rate: f64,
        metrics: &[(String, f64)],
        clock: Clock,
    ) -> Result<(), Error> {
        let phases = [("stepping", clock.stepping), ("inference", clock.inference), ("learning", clock.learning)];
        let seconds = phases.map(|(name, time)| (name, time.as_secs_f64()));
        let mut row: Map<String, Json> = Map::new();
        row.insert("update".to_owned(), update.into());
        row.insert("steps".to_owned(), steps.into());
        row.insert("steps_per_second".to_owned(), rate.into());
        let phases = seconds.iter().map(|(name, time)| (format!("seconds/{name}"), *time));
        let numbers: Vec<(String, f64)> = metrics.iter().cloned().chain(phases).collect();
        // A number that is not finite becomes null.
        row.extend(numbers.iter().map(|(name, value)| (name.clone(), (*value).into())));
        let line = format!("{}\n", Json::Object(row));
        self.progress.write_all(line.as_bytes()).map_err(file(&self.path))?;
        for (name, value) in numbers.iter().chain([&("steps_per_second".to_owned(), rate)]) {
            let tag = if name.contains('/') { name.clone() } else { format!("learning/{name}") };
            self.events.scalar(&tag, *value as f32, steps)?;
        }
        self.events.scalar("update", update as f32, steps)?;
        self.line(update, steps, rate, metrics, &seconds);
        Ok(())
    }

    /// Waits until the rows are on disk. A checkpoint must not outlive the rows of its updates when the machine fails.
    pub fn sync(&self) -> Result<(), Error> {
        self.progress.sync_data().map_err(file(&self.path))
    }

    /// Prints one update.
    fn line(&mut self, update: u64, steps: u64, rate: f64, metrics: &[(String, f64)], seconds: &[(&str, f64)]) {
        let total: f64 = seconds.iter().map(|(_, time)| time).sum();
        self.recent.push_back(total);
        self.recent.drain(..self.recent.len().saturating_sub(20));
        let mean = self.recent.iter().sum::<f64>() / self.recent.len() as f64;
        let left = duration(self.updates.saturating_sub(update) as f64 * mean);
        let of = |name: &str| metrics.iter().find(|(found, _)| found == name).map(|(_, value)| *value);
        let episodes = match (of("episode/reward"), of("episode/length")) {
            (Some(reward), Some(length)) => format!("reward {reward:.4} length {length:.1}"),
            _ => "no episode has ended yet".to_owned(),
        };
        let (loss, entropy) = (of("loss").unwrap_or(f64::NAN), of("entropy").unwrap_or(f64::NAN));
        let shares: Vec<_> =
            seconds.iter().map(|(name, time)| format!("{name} {:3.0}%", 100.0 * time / total)).collect();
        let (updates, shares) = (self.updates, shares.join(" "));
        print(format_args!(
            "{update:>5}/{updates} {steps:>11} steps {rate:>8.0}/s {left:>12} left  {episodes}  loss {loss:.4} entropy \
             {entropy:.3}  {shares}"
        ));
    }
}

/// Prints a line. A terminal or a pipe that is gone does not end the run.
pub fn print(line: impl std::fmt::Display) {
    let mut stdout = io::stdout().lock();
    let _ = writeln!(stdout, "{}", printable(line)).and_then(|()| stdout.flush());
}

/// A duration for a line of text, such as `2.5 hours`.
fn duration(seconds: f64) -> String {
    for (unit, size) in [("days", 86_400.0), ("hours", 3_600.0), ("minutes", 60.0)] {
        if seconds >= size {
            return format!("{:.1} {unit}", seconds / size);
        }
    }
    format!("{seconds:.0} seconds")
}

/// A file of TensorBoard's events: records of TensorFlow with messages of protocol buffers.
///
/// A record is the length of its data (u64), a masked CRC-32C of the length, the data, and a masked CRC-32C of the data. The fields of
/// the messages are those of `event.proto` and `summary.proto`.
struct Events {
    path: PathBuf,
    file: File,
}

impl Events {
    fn create(run: &Path) -> Result<Self, Error> {
        let (process, host) = (std::process::id(), rustix::system::uname());
        let (time, host) = (unix_time(), host.nodename().to_string_lossy());
        // The fraction tells files apart that one process writes in the same second.
        let path = run.join(format!("events.out.tfevents.{time:.6}.{host}.{process}"));
        let created = File::create(&path).map_err(file(&path))?;
        let mut events = Events { path, file: created };
        events.write(&[bytes(3, b"brain.Event:2")].concat())?;
        Ok(events)
    }

    fn scalar(&mut self, tag: &str, value: f32, step: u64) -> Result<(), Error> {
        let value = [bytes(1, tag.as_bytes()), [&[0x15][..], &value.to_le_bytes()].concat()].concat();
        self.write(&[vec![0x10], varint(step), bytes(5, &bytes(1, &value))].concat())
    }

    /// Writes an event with the current time and these fields.
    fn write(&mut self, fields: &[u8]) -> Result<(), Error> {
        let data = [&[0x09][..], &unix_time().to_le_bytes(), fields].concat();
        let length = (data.len() as u64).to_le_bytes();
        let masked = |data: &[u8]| crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes();
        let record = [&length[..], &masked(&length), &data, &masked(&data)].concat();
        self.file.write_all(&record).map_err(file(&self.path))
    }
}

fn unix_time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64()
}

/// A field of bytes, text or a message.
fn bytes(field: u8, content: &[u8]) -> Vec<u8> {
    [vec![field << 3 | 2], varint(content.len() as u64), content.to_vec()].concat()
}

/// An integer, seven bits in a byte.
fn varint(mut number: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while number >= 0x80 {
        bytes.push(number as u8 | 0x80);
        number >>= 7;
    }
    bytes.push(number as u8);
    bytes
}
