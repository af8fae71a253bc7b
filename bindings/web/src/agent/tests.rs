//! Compares the page's agents with outputs recorded from PyTorch and with the trainer, and reads broken files.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use clap::{Args, Command, FromArgMatches};
use endless_gym_core::batch::{Batch, BatchBuffer};
use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
use endless_gym_memory_gym::memory_gym;
use endless_gym_trainer::checkpoint::Checkpoint;
use endless_gym_trainer::environments::Environments;
use endless_gym_trainer::{learn, network};
use safetensors::tensor::TensorView;
use serde::Deserialize;

use super::*;

const AGENT: &[u8] = include_bytes!("../../../../engine/page/files/MortarMayhem-Grid-v0.safetensors");

/// Recorded by `python -m endless_gym_agents.export --vectors`.
#[derive(Deserialize)]
struct Vectors {
    env: String,
    reset: Vec<bool>,
    features: Vec<Vec<f32>>,
    logits: Vec<Vec<f32>>,
}

/// Relative to the largest number, since smaller ones are differences of terms of its size.
fn largest_difference(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let size = expected.iter().fold(1.0, |size: f32, number| size.max(number.abs()));
    found.iter().zip(expected).map(|(a, b)| (a - b).abs() / size).fold(0.0, f32::max)
}

#[test]
fn the_networks_compute_what_pytorch_computes() {
    // Those of the page, and three with two layers of two heads each.
    let folders = ["../../engine/page/files", "tests/agents"].map(|folder| std::fs::read_dir(folder).unwrap());
    let files = folders.into_iter().flatten().map(|file| file.unwrap().path());
    let files: Vec<_> = files.filter(|path| path.extension().is_some_and(|ending| ending == "safetensors")).collect();
    assert!(files.len() >= 8, "{files:?}");
    for path in files {
        let file = std::fs::read(&path).unwrap();
        assert!(file.len() <= 96 << 10, "{}: {} bytes", path.display(), file.len());
        let vectors = Path::new("tests/agents").join(path.file_name().unwrap()).with_extension("json");
        let vectors = std::fs::read_to_string(vectors).unwrap();
        computes(&Agent::read(&file).unwrap(), &serde_json::from_str(&vectors).unwrap());
    }
}

fn computes(agent: &Agent, vectors: &Vectors) {
    assert_eq!(agent.env(), vectors.env);
    let mut memory = agent.memory(0);
    let mut episodes = 0;
    for ((features, expected), reset) in vectors.features.iter().zip(&vectors.logits).zip(&vectors.reset) {
        if *reset {
            memory = agent.memory(0);
            episodes += 1;
        }
        agent.step(features, &mut memory);
        let found = &memory.pass.logits;
        assert!(largest_difference(found, expected) <= 1e-5, "{found:?} {expected:?}");
    }
    assert!(episodes >= 2 && vectors.features.len() >= 90, "{episodes} episodes");
    // Without the hidden state, the logits of an agent with memory differ.
    let last = vectors.features.len() - 1;
    let mut forgotten = agent.memory(0);
    agent.step(&vectors.features[last], &mut forgotten);
    let differs = largest_difference(&forgotten.pass.logits, &vectors.logits[last]) > 0.01;
    assert!(vectors.reset[last] || differs != (agent.description()["agent"] == "none"));
}

#[test]
fn a_checkpoint_of_the_trainer_plays_as_in_the_trainer() {
    let folder = std::env::temp_dir().join(format!("endless-page-agent-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    for (agent, flags) in [
        ("gru", "--recurrence.layers=2 --recurrence.residual"),
        ("mingru", "--recurrence.embedding=false"),
        ("none", ""),
    ] {
        let run = folder.join(agent);
        let text = format!(
            "learn MortarMayhem-Grid-v0 --agent {agent} --run {} --ppo.updates 1 --ppo.steps 16 --model.head-width 8 \
             --environment.num-envs 4 --recurrence.hidden-size 12 --environment.option=command_count=[1,2] {flags}",
            run.display()
        );
        let matches = endless_gym_trainer::settings::Settings::augment_args(Command::new("learn"));
        let matches = matches.get_matches_from(text.split_whitespace());
        let settings = FromArgMatches::from_arg_matches(&matches).unwrap();
        let make = |settings: &_| Environments::in_process(memory_gym(), settings);
        learn(&settings, make, &AtomicBool::new(false)).unwrap();
        let page = Agent::read(&std::fs::read(run.join("checkpoints/last.safetensors")).unwrap()).unwrap();
        let description = page.description();
        assert_eq!((&description["agent"], &description["steps"]), (&json!(agent), &json!(64)));
        assert_eq!((&description["options"], page.env()), (&json!({"command_count": [1, 2]}), "MortarMayhem-Grid-v0"));
        assert!(memory_gym().specs().all(|spec| page.fits(spec) == (spec.id == "MortarMayhem-Grid-v0")));

        let mut random = Generator::from_seed(1);
        let mut trained = network::new(&settings, page.network.spec.observation_width, vec![4], &mut random);
        Checkpoint::read(&run).unwrap().start(&mut trained).unwrap();
        // An episode in which the page plays; the trainer's network computes all of its steps at once.
        let config = PoolConfig::new("MortarMayhem-Grid-v0", 1).features(true).frames(None);
        let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
        let mut buffer = BatchBuffer::new(pool.layout().blocks());
        pool.reset(ResetRequest::Seed(5), &mut buffer).unwrap();
        let (mut memory, mut whole, mut action, mut found) = (page.memory(5), Pass::default(), [0], Vec::new());
        let mut chosen = [0; 4];
        for _ in 0..40 {
            let features = Batch::new(pool.layout(), &buffer).features().to_vec();
            page.act(&features, &mut memory, &mut action);
            chosen[action[0] as usize] += 1;
            found.extend_from_slice(&memory.pass.logits);
            whole.observations.extend(features);
            pool.step(&action, &mut buffer).unwrap();
        }
        assert!(chosen.iter().all(|count| *count < 40), "{chosen:?}");
        whole.states = vec![vec![0.0; trained.spec.hidden_size]; trained.spec.layers];
        trained.forward(Sequences::new(1, &[false; 40]).unwrap(), &mut whole);
        assert_eq!(found, whole.logits, "{agent}");
    }
    std::fs::remove_dir_all(folder).unwrap();
}

/// A changed file with the checksum of what it now contains, so that only the agent can refuse it. One without a header has no checksum,
/// and one that is not in the format safetensors stays as it is.
fn sealed(file: Vec<u8>) -> Vec<u8> {
    let (Ok(tensors), Ok((_, metadata))) = (SafeTensors::deserialize(&file), SafeTensors::read_metadata(&file)) else {
        return file;
    };
    match metadata.metadata().as_ref().and_then(|entries| entries.get("endless")) {
        Some(header) => file::write(header.clone(), tensors.tensors()).unwrap(),
        None => safetensors::serialize(tensors.tensors(), None).unwrap(),
    }
}

#[test]
fn a_broken_file_is_refused() {
    let refused = |file: &[u8]| Agent::read(file).map(drop).unwrap_err();
    assert!(matches!(refused(b"PK no agent"), AgentFileError::File(FileError::Format(_))));
    assert!(matches!(refused(&[AGENT, b"more"].concat()), AgentFileError::File(FileError::Format(_))));
    // Every prefix is refused without a panic.
    for length in (0..AGENT.len()).step_by(97).chain([7, 8, AGENT.len() - 1]) {
        assert!(matches!(refused(&AGENT[..length]), AgentFileError::File(FileError::Format(_))), "{length}");
    }
    // The sign of the last weight.
    let damaged = [&AGENT[..AGENT.len() - 1], &[AGENT[AGENT.len() - 1] ^ 128]].concat();
    assert_eq!(refused(&damaged).to_string(), "the file of the agent is damaged: its checksum differs");
    let with = |start: usize, bytes: &[u8]| {
        let mut file = AGENT.to_vec();
        file[start..start + bytes.len()].copy_from_slice(bytes);
        sealed(file)
    };
    let nan = refused(&with(AGENT.len() - 4, &f32::NAN.to_le_bytes()));
    assert!(matches!(nan, AgentFileError::NotFinite { given, .. } if given.is_nan()), "{nan}");
    // Other names, kinds and shapes.
    let replaced = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        let at = AGENT.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
        refused(&with(at, to.as_bytes()))
    };
    assert!(matches!(replaced("\"endless\"", "\"nothing\""), AgentFileError::WeightsOnly));
    assert!(matches!(replaced(r#"\"steps\":"#, r#"\"stops\":"#), AgentFileError::Header(_)));
    let kind = replaced(r#"\"agent\":\"gru\""#, r#"\"agent\":\"abc\""#);
    assert_eq!(
        kind.to_string(),
        "an agent on the page must be one of gru, mingru, gated-deltanet, mamba2, retnet, none, got abc"
    );
    let bias = replaced("\"memory.embedding.0.bias\"", "\"memory.embedding.9.bias\"");
    let text = "the agent must have a float32 tensor `memory.embedding.0.bias` of shape [48], got none";
    assert_eq!(bias.to_string(), text);
    assert!(matches!(replaced("\"shape\":[32,17]", "\"shape\":[17,32]"), AgentFileError::Tensor { .. }));
}

#[test]
fn a_damaged_file_is_refused_or_plays() {
    let draws = &mut Generator::from_seed(35);
    let stacks =
        ["gated-deltanet", "mamba2", "retnet"].map(|name| std::fs::read(format!("tests/agents/{name}.safetensors")));
    let mut files = vec![AGENT.to_vec()];
    files.extend(stacks.map(Result::unwrap));
    // The last one is empty.
    let words = r#"0 -1 4096 1e400 18446744073709551615 null [] { " \ F64 [[[[ gru retnet "#;
    let words: Vec<&str> = words.split(' ').collect();
    for whole in files {
        let header = u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
        let (mut refused, mut played) = (0, 0);
        for _ in 0..1_000 {
            let mut text = whole[8..8 + header].to_vec();
            for _ in 0..draws.integers(1, 4) {
                let start = draws.integers(0, text.len() as i64) as usize;
                let end = (start + draws.integers(0, 8) as usize).min(text.len());
                text.splice(start..end, draws.choice(&words).bytes());
            }
            let file = [&(text.len() as u64).to_le_bytes(), &text[..], &whole[8 + header..]].concat();
            match Agent::read(&sealed(file)) {
                Err(_) => refused += 1,
                Ok(agent) => {
                    let features = vec![1.0; agent.network.spec.observation_width];
                    let mut action = vec![-1; agent.network.spec.choices.len()];
                    agent.act(&features, &mut agent.memory(1), &mut action);
                    let choices = agent.network.spec.choices.iter().map(|choices| *choices as i32);
                    assert!(action.iter().zip(choices).all(|(action, choices)| (0..choices).contains(action)));
                    assert!(agent.description().is_object());
                    played += 1;
                }
            }
        }
        assert!(refused > 250 && played > 50, "{refused} refused, {played} played");
    }
}

/// The file of an agent in which tensors have other shapes, with zeros, so that only the agent can refuse it.
fn reshaped(file: &[u8], shapes: &[(&str, &[usize])]) -> Vec<u8> {
    let File { tensors, header } = file::read(file).unwrap();
    let zeros = vec![0; 1 << 16];
    let views = tensors.iter().map(|(name, view)| {
        let other = shapes.iter().find(|(changed, _)| *changed == name);
        let view = other.map_or(view, |(_, shape)| {
            TensorView::new(Dtype::F32, shape.to_vec(), &zeros[..4 * shape.iter().product::<usize>()]).unwrap()
        });
        (name.to_owned(), view)
    });
    file::write(header.unwrap(), views.collect()).unwrap()
}

#[test]
fn layers_that_do_not_fit_are_refused() {
    for name in ["gated-deltanet", "mamba2", "retnet"] {
        let file = std::fs::read(format!("tests/agents/{name}.safetensors")).unwrap();
        let tensors = SafeTensors::deserialize(&file).unwrap();
        for (changed, view) in tensors.iter() {
            for axis in 0..view.shape().len() {
                for size in [0, 1, 3, 5, 7, 24, 48] {
                    let mut shape = view.shape().to_vec();
                    shape[axis] = size;
                    // The number of features is free; it has to fit the environment.
                    let is_free = (changed, axis) == ("encoder.vector.0.weight", 1) && size > 0;
                    let read = Agent::read(&reshaped(&file, &[(changed, &shape)]));
                    assert_eq!(read.is_ok(), is_free || shape == view.shape(), "{name}: {changed} {shape:?}");
                }
            }
        }
        // Without an embedding, the encoder must have the memory's width.
        let wide: [(&str, &[usize]); 3] =
            [("encoder.vector.0.weight", &[24, 17]), ("encoder.vector.0.bias", &[24]), ("body.0.weight", &[12, 24])];
        let wide = reshaped(&file, &wide);
        let error = Agent::read(&wide).map(drop).unwrap_err();
        assert!(matches!(error, AgentFileError::Heads { width: 12, given: 24, .. }), "{error}");
    }
    // Five heads for 16 channels, in tensors that agree.
    let file = std::fs::read("tests/agents/gated-deltanet.safetensors").unwrap();
    let [a_log, dt_bias, enter] =
        ["a_log", "dt_bias", "enter.weight"].map(|part| format!("memory.cell.layers.0.{part}"));
    let five = reshaped(&file, &[(&a_log, &[5]), (&dt_bias, &[5]), (&enter, &[32 + 16 + 10, 12])]);
    let error = Agent::read(&five).map(drop).unwrap_err();
    assert!(matches!(error, AgentFileError::Heads { heads: 5, channels: 16, .. }), "{error}");
}
