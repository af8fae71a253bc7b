//! Compares the page's agent with outputs recorded from PyTorch, and reads broken files.

use endless_gym_memory_gym::memory_gym;
use serde::Deserialize;

use super::*;

const AGENT: &[u8] = include_bytes!("../../../../engine/view/page/files/MortarMayhem-Grid-v0.agent.bin");

/// Recorded by `python -m endless_gym_agents.export --vectors`.
#[derive(Deserialize)]
struct Vectors {
    env: String,
    reset: Vec<bool>,
    features: Vec<Vec<f32>>,
    logits: Vec<Vec<f32>>,
}

fn vectors() -> Vectors {
    serde_json::from_str(include_str!("../../tests/agents/MortarMayhem-Grid-v0.json")).unwrap()
}

#[test]
fn the_network_computes_what_pytorch_computes() {
    let (agent, vectors) = (Agent::read(AGENT).unwrap(), vectors());
    assert_eq!(agent.env(), vectors.env);
    let mut memory = agent.memory(0);
    let mut episodes = 0;
    for ((features, expected), reset) in vectors.features.iter().zip(&vectors.logits).zip(&vectors.reset) {
        if *reset {
            memory = agent.memory(0);
            episodes += 1;
        }
        let found = agent.network.step(features, &mut memory.hidden);
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() <= 1e-5 * expected.abs().max(1.0), "{found} {expected}");
        }
    }
    assert!(episodes >= 3 && vectors.features.len() >= 90, "{episodes} episodes");
    // Without the hidden state, the logits differ.
    let last = vectors.features.len() - 1;
    let forgotten = agent.network.step(&vectors.features[last], &mut agent.memory(0).hidden);
    let difference = forgotten.iter().zip(&vectors.logits[last]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(vectors.reset[last] || difference > 0.01, "{difference}");
}

#[test]
fn an_agent_fits_only_its_environment() {
    let agent = Agent::read(AGENT).unwrap();
    let fitting: Vec<_> = memory_gym().specs().filter(|spec| agent.fits(spec)).map(|spec| spec.id).collect();
    assert_eq!(fitting, ["MortarMayhem-Grid-v0"]);
}

#[test]
fn samples_have_the_probabilities_of_the_softmax() {
    let logits = [0.0_f32, 1.0, -1.0];
    let sum: f32 = logits.iter().map(|logit| logit.exp()).sum();
    let mut random = Generator::from_seed(7);
    let mut counts = [0_u32; 3];
    for _ in 0..20_000 {
        counts[sample(&logits, &mut random)] += 1;
    }
    for (count, logit) in counts.iter().zip(logits) {
        assert!((*count as f32 / 20_000.0 - logit.exp() / sum).abs() < 0.015, "{counts:?}");
    }
}

#[test]
fn a_broken_file_is_refused() {
    let refused = |file: &[u8]| Agent::read(file).unwrap_err();
    let with = |start: usize, bytes: &[u8]| {
        let mut file = AGENT.to_vec();
        file[start..start + bytes.len()].copy_from_slice(bytes);
        file
    };
    assert!(matches!(refused(b""), AgentFileError::Magic));
    assert!(matches!(refused(b"PK no agent"), AgentFileError::Magic));
    assert!(matches!(refused(&with(8, &9_u32.to_le_bytes())), AgentFileError::Version { given: 9 }));
    assert!(matches!(refused(&with(16, b"!")), AgentFileError::Header(_)));
    assert!(matches!(refused(&with(12, &u32::MAX.to_le_bytes())), AgentFileError::Length { .. }));
    assert!(matches!(refused(&[AGENT, b"more"].concat()), AgentFileError::Length { .. }));
    assert!(matches!(
        refused(&with(AGENT.len() - 4, &f32::NAN.to_le_bytes())),
        AgentFileError::NotFinite { given, .. } if given.is_nan()
    ));
    // Every prefix is refused without a panic.
    for length in (0..AGENT.len()).step_by(97).chain([8, 11, 12, 15, 16, AGENT.len() - 1]) {
        assert!(matches!(refused(&AGENT[..length]), AgentFileError::Magic | AgentFileError::Length { .. }), "{length}");
    }
    // Headers with other layers, or with sizes that do not match the file.
    let renamed = |from: &str, to: &str| {
        let at = AGENT.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
        refused(&with(at, to.as_bytes()))
    };
    let error = renamed("memory.embedding.0.bias", "memory.embedding.9.bias");
    assert!(matches!(&error, AgentFileError::Tensor { name, .. } if name == "memory.embedding.0.bias"), "{error}");
    assert_eq!(error.to_string(), "the agent must have a tensor `memory.embedding.0.bias` of shape [any], got none");
    assert!(matches!(renamed(r#""shape":[32,17]"#, r#""shape":[17,32]"#), AgentFileError::Tensor { .. }));
    assert!(matches!(renamed(r#""shape":[32,17]"#, r#""shape":[99,99]"#), AgentFileError::Length { .. }));
}
