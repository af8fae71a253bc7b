//! Checkpoints: the state from which a run resumes exactly, in the format safetensors.
//!
//! The weights have their names and shapes in PyTorch's `state_dict`, so that any reader of the format finds them. The other tensors
//! begin with `state/`, and the rest is in the header of the [`file`](mod@endless_gym_kernels::file). The random numbers need no state: each
//! update has a generator of its own.

use std::fs;
use std::path::{Path, PathBuf};

use endless_gym_core::files;
use endless_gym_kernels::adamw::AdamW;
use endless_gym_kernels::file::{self as agent_file, VERSION};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use crate::error::{Error, file};
use crate::metrics::Episode;
use crate::rollout::State;
use crate::settings::{self, Agent, Settings};
use endless_gym_kernels::network::{Network, Tensor};

/// Names in the folder of a run: the folder of the checkpoints, and the last checkpoint in it.
const FOLDER: &str = "checkpoints";
const LAST: &str = "last.safetensors";

/// Largest numbers of updates and of steps that a header may claim: far more than any run has, and far from an overflow.
const MAX_UPDATES: i32 = 1 << 30;
const MAX_STEPS: u64 = 1 << 53;

/// What a checkpoint holds besides numbers.
#[derive(Serialize, Deserialize)]
struct Header {
    version: u32,
    update: u64,
    steps: u64,
    optimizer_updates: i32,
    episodes: Vec<Episode>,
    settings: Settings,
}

/// Writes a checkpoint as the last one of a run, atomically, and with `keep` also under the number of its update. Fails
/// with [`Error::File`], as on a full disk; the former checkpoint stays the last one.
pub fn save(
    run: &Path,
    settings: &Settings,
    (update, steps): (u64, u64),
    network: &Network,
    optimizer: &AdamW,
    state: &State,
    keep: bool,
) -> Result<(), Error> {
    let (mean, square, optimizer_updates) = optimizer.state();
    let episodes = state.episodes.iter().cloned().collect();
    let header = Header { version: VERSION, update, steps, optimizer_updates, episodes, settings: settings.clone() };
    let header = serde_json::to_string(&header).map_err(Error::json("the header"))?;
    let lengths: Vec<u64> = state.snapshots.iter().map(|snapshot| snapshot.len() as u64).collect();
    let (snapshots, starts) =
        (state.snapshots.concat(), state.starts.iter().map(|start| u8::from(*start)).collect::<Vec<_>>());

    let floats = |name: &str, numbers: &[f32], shape: Vec<usize>| {
        (name.to_owned(), Dtype::F32, shape, bytemuck::cast_slice(numbers).to_vec())
    };
    let weights =
        network.tensors.iter().map(|t| floats(&t.name, &network.parameters[t.range.clone()], t.shape.clone()));
    let hidden = state.hidden.iter().enumerate().map(|(layer, hidden)| {
        floats(&format!("state/hidden/{layer}"), hidden, vec![starts.len(), network.spec.hidden_size])
    });
    let others = [
        floats("state/optimizer/mean", mean, vec![mean.len()]),
        floats("state/optimizer/square", square, vec![square.len()]),
        ("state/starts".to_owned(), Dtype::U8, vec![starts.len()], starts.clone()),
        ("state/environments".to_owned(), Dtype::U8, vec![snapshots.len()], snapshots),
        ("state/lengths".to_owned(), Dtype::U64, vec![lengths.len()], bytemuck::cast_slice(&lengths).to_vec()),
    ];
    let actions = (!state.actions.is_empty()).then(|| {
        let shape = vec![starts.len(), state.actions.len() / starts.len()];
        ("state/actions".to_owned(), Dtype::I32, shape, bytemuck::cast_slice(&state.actions).to_vec())
    });
    let folder = run.join(FOLDER);
    let last = folder.join(LAST);
    let tensors: Vec<_> = weights.chain(hidden).chain(others).chain(actions).collect();
    let views = tensors
        .iter()
        .map(|(name, dtype, shape, bytes)| Ok((name.clone(), TensorView::new(*dtype, shape.clone(), bytes)?)));
    let wrong = |error: safetensors::SafeTensorError| Error::Checkpoint { path: last.clone(), what: error.to_string() };
    let views = views.collect::<Result<Vec<_>, _>>().map_err(wrong)?;
    let content = agent_file::write(header, views).map_err(wrong)?;

    let write = || {
        fs::create_dir_all(&folder)?;
        if keep {
            // First, since a run that resumes from the last one does not write its number again.
            files::replace(&folder.join(format!("update-{update:06}.safetensors")), &content)?;
        }
        files::replace(&last, &content)
    };
    write().map_err(file(&last))
}

/// Whether a run has a last checkpoint, of this program or of the Python agents.
pub(crate) fn exists(run: &Path) -> bool {
    [LAST, "last.pt"].iter().any(|name| run.join(FOLDER).join(name).exists())
}

/// The content of a checkpoint file.
pub struct Checkpoint {
    path: PathBuf,
    content: Vec<u8>,
}

impl Checkpoint {
    /// Reads a checkpoint file, or the last checkpoint of the run in a folder. Fails with [`Error::Checkpoint`] if
    /// there is none.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let path = if path.is_dir() { path.join(FOLDER).join(LAST) } else { path.to_owned() };
        if !path.exists() && path.with_extension("pt").exists() {
            let run = path.parent().and_then(Path::parent).unwrap_or(&path).display();
            let what = format!(
                "is one of endless-train; continue it with: endless-train --resume {run}; or write its weights for --init-from with: \
                 python -m endless_gym_agents.export {run} --weights FILE.safetensors"
            );
            return Err(Error::Checkpoint { path: path.with_extension("pt"), what });
        }
        if !path.exists() {
            return Err(Error::Checkpoint { path, what: "does not exist".to_owned() });
        }
        let content = files::read(&path).map_err(file(&path))?;
        Ok(Checkpoint { path, content })
    }

    fn wrong(&self, what: impl Into<String>) -> Error {
        Error::Checkpoint { path: self.path.clone(), what: what.into() }
    }

    /// The tensors and the text of the header, which files of weights lack.
    fn tensors(&self) -> Result<(SafeTensors<'_>, Option<String>), Error> {
        let read = agent_file::read(&self.content).map_err(|error| self.wrong(error.to_string()))?;
        Ok((read.tensors, read.header))
    }

    /// The header, which only a checkpoint of a run has.
    fn header(&self, text: Option<String>) -> Result<Header, Error> {
        let text = text.ok_or_else(|| self.wrong("cannot be resumed, as it has weights only; use --init-from"))?;
        let header: Header = serde_json::from_str(&text).map_err(Error::json(self.path.display()))?;
        let Header { update, steps, optimizer_updates, .. } = header;
        if update > MAX_UPDATES as u64 || steps > MAX_STEPS || !(0..=MAX_UPDATES).contains(&optimizer_updates) {
            let given = format!("{update} updates, {optimizer_updates} of the optimizer, and {steps} steps");
            return Err(self.wrong(format!("cannot be resumed, as it claims {given}")));
        }
        Ok(header)
    }

    /// Checks that the checkpoint is of a run with these settings and has weights of these sizes, before a network
    /// takes memory for them. Fails with [`Error::Checkpoint`] or [`Error::Json`] if it is damaged, and
    /// [`Error::Settings`] if it is of another run.
    pub fn check(&self, settings: &Settings) -> Result<(), Error> {
        settings.check_resumable(&self.header(self.tensors()?.1)?.settings)?;
        let hidden = if settings.agent == Agent::None { 1 } else { settings.recurrence.hidden_size };
        let model = &settings.model;
        let body = if model.body_width > 0 { model.body_width } else { hidden };
        // Fewer than the network has.
        let others = model.vector_width + (hidden + 2 * model.head_width) * body;
        let weights = settings.recurrence.layers * 2 * hidden * hidden + others;
        if size_of::<f32>() * weights > self.content.len() {
            return Err(self.wrong(format!("has {} bytes, too few for {weights} weights", self.content.len())));
        }
        Ok(())
    }

    /// The numbers of a tensor, which must have this type and shape.
    fn numbers<T: bytemuck::AnyBitPattern>(
        &self,
        tensors: &SafeTensors<'_>,
        name: &str,
        dtype: Dtype,
        shape: &[usize],
    ) -> Result<Vec<T>, Error> {
        let tensor = tensors.tensor(name).map_err(|_| self.wrong(format!("has no {name}")))?;
        if tensor.dtype() != dtype || tensor.shape() != shape {
            let given = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
            return Err(self.wrong(format!("must have {name} of {dtype:?} {shape:?}, got {given}")));
        }
        Ok(tensor.data().chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect())
    }

    /// Sets the weights of a network, and returns the names of those that are missing or have other shapes. With `all`, and in the
    /// memory and the body, that is an error.
    fn load_weights(&self, tensors: &SafeTensors<'_>, network: &mut Network, all: bool) -> Result<Vec<String>, Error> {
        let mut missing = Vec::new();
        for Tensor { name, shape, range } in network.tensors.clone() {
            match self.numbers::<f32>(tensors, &name, Dtype::F32, &shape) {
                Ok(weights) if weights.iter().all(|weight| weight.is_finite()) => {
                    network.parameters[range].copy_from_slice(&weights);
                }
                Ok(_) => return Err(self.wrong(format!("has weights that are not finite, in {name}"))),
                Err(error) if all || ["memory.", "body."].iter().any(|part| name.starts_with(part)) => {
                    return Err(error);
                }
                Err(_) => missing.push(name),
            }
        }
        network.pack();
        Ok(missing)
    }

    /// Sets weights and optimizer of a run with the same settings. Returns the number of updates and of steps so far, and the state
    /// of the environments. Fails with [`Error::Checkpoint`] if it does not fit.
    pub fn resume(
        &self,
        network: &mut Network,
        optimizer: &mut AdamW,
        num_envs: usize,
    ) -> Result<(u64, u64, State), Error> {
        let (tensors, text) = self.tensors()?;
        let header = self.header(text)?;
        self.load_weights(&tensors, network, true)?;
        let count = [network.parameters.len()];
        let mean = self.numbers(&tensors, "state/optimizer/mean", Dtype::F32, &count)?;
        let square = self.numbers(&tensors, "state/optimizer/square", Dtype::F32, &count)?;
        *optimizer = AdamW::from_state(mean, square, header.optimizer_updates);
        let shape = [num_envs, network.spec.hidden_size];
        let hidden = |layer| self.numbers(&tensors, &format!("state/hidden/{layer}"), Dtype::F32, &shape);
        let hidden = (0..network.spec.layers).map(hidden).collect::<Result<_, _>>()?;
        let starts: Vec<u8> = self.numbers(&tensors, "state/starts", Dtype::U8, &[num_envs])?;
        let lengths: Vec<u64> = self.numbers(&tensors, "state/lengths", Dtype::U64, &[num_envs])?;
        let total = lengths.iter().try_fold(0, |sum: usize, length| sum.checked_add(usize::try_from(*length).ok()?));
        let total = total.ok_or_else(|| self.wrong("has invalid lengths of snapshots"))?;
        let bytes: Vec<u8> = self.numbers(&tensors, "state/environments", Dtype::U8, &[total])?;
        let mut rest = bytes.into_iter();
        let snapshots = lengths.iter().map(|length| rest.by_ref().take(*length as usize).collect()).collect();
        let starts = starts.iter().map(|start| *start != 0).collect();
        let actions = match settings::has_previous_action(&header.settings.environment.wrapper) {
            true => self.numbers(&tensors, "state/actions", Dtype::I32, &[num_envs, network.spec.choices.len()])?,
            false => Vec::new(),
        };
        Ok((
            header.update,
            header.steps,
            State { hidden, starts, actions, episodes: header.episodes.into(), snapshots },
        ))
    }

    /// Copies weights into a new network; the encoder and the heads keep theirs where shapes differ. Returns a line of text that says
    /// which weights were copied. Fails with [`Error::Checkpoint`] if the memories or the layers after them differ.
    pub fn start(&self, network: &mut Network) -> Result<String, Error> {
        let missing = self.load_weights(&self.tensors()?.0, network, false)?;
        let (all, path) = (network.tensors.len(), self.path.display());
        let others =
            if missing.is_empty() { String::new() } else { format!("; newly initialised: {}", missing.join(", ")) };
        Ok(format!("started from {} of {all} tensors of {path}{others}", all - missing.len()))
    }
}
