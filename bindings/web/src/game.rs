//! One environment that a person, an expert, an agent or a trace plays, with a recording.

use std::rc::Rc;

use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::envs::Expert;
use endless_gym_core::pool::{Autoreset, OptionMap, Pool, PoolConfig, ResetOptions, ResetRequest, Seeding, Threads};
use endless_gym_core::trace::{Recorder, Trace};
use endless_gym_memory_gym::{SCREEN, memory_gym};
use serde_json::{Map, Value as Json, json};

use crate::agent::{Agent, Memory};
use crate::clues::Clues;
use crate::error::WebError;
use crate::pixels::{RGBA_BYTES, put_observation, put_view};

/// Who chooses the action of a step.
pub enum Player {
    Person(Vec<i32>),
    Expert,
    Agent(Rc<Agent>),
    Trace,
}

pub struct Game {
    pool: Pool,
    blocks: Vec<Block>,
    options: OptionMap,
    seed: Option<u64>,
    recorder: Recorder,
    expert: Box<dyn Expert>,
    /// Whether the expert has seen every observation of the episode so far.
    expert_is_in: bool,
    /// The agent's memory, if it has played the episode from its start.
    agent_memory: Option<Memory>,
    clues: Clues,
    action: Vec<i32>,
    /// The replayed trace, and the number of its current episode.
    script: Option<(Trace, usize)>,
    observation: Vec<u8>,
    view: Vec<u8>,
}

impl Game {
    /// Starts an episode of a new environment, so that it depends only on these arguments.
    pub fn start(id: &str, options: OptionMap, seed: u64) -> Result<Self, WebError> {
        Self::new(id, options, Some(seed), None)
    }

    /// Starts the first episode of a trace.
    pub fn replay(trace: Trace) -> Result<Self, WebError> {
        let (id, options) = (trace.env.clone(), trace.options.clone());
        let seed = trace.episodes.first().and_then(|episode| episode.seed);
        Self::new(&id, options, seed, Some((trace, 0)))
    }

    fn new(id: &str, options: OptionMap, seed: Option<u64>, script: Option<(Trace, usize)>) -> Result<Self, WebError> {
        let config = PoolConfig {
            options: ResetOptions::Shared(options.clone()),
            autoreset: Autoreset::Disabled,
            seeding: Seeding::Continue { seed: Some(0) },
            features: true,
            ..PoolConfig::new(id, 1)
        };
        let pool = Pool::new(memory_gym(), &config, &Threads::new(1)?)?;
        let blocks = zeroed(pool.layout().blocks());
        let mut game = Game {
            expert: memory_gym().expert(pool.spec().id)?,
            expert_is_in: true,
            agent_memory: None,
            clues: Clues::new(pool.spec()),
            action: vec![0; pool.spec().action_space.width()],
            recorder: Recorder::new(id, &options),
            pool,
            blocks,
            options,
            seed,
            script,
            observation: vec![0; RGBA_BYTES],
            view: vec![0; RGBA_BYTES],
        };
        game.reset(seed)?;
        Ok(game)
    }

    fn reset(&mut self, seed: Option<u64>) -> Result<(), WebError> {
        self.seed = seed;
        match seed {
            Some(seed) => self.pool.reset(ResetRequest::Seed(seed), &mut self.blocks)?,
            None => self.pool.reset(ResetRequest::All, &mut self.blocks)?,
        }
        self.recorder.reset(seed, &self.pool, &self.blocks);
        self.expert.reset();
        self.expert_is_in = true;
        self.agent_memory = None;
        self.clues.reset();
        self.action.fill(0);
        self.observe()
    }

    fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }

    /// Plays one step. After the last step of a trace's episode, a trace step starts the next episode.
    pub fn step(&mut self, player: Player) -> Result<(), WebError> {
        match player {
            Player::Person(action) => {
                (self.expert_is_in, self.agent_memory) = (false, None);
                self.action = action;
            }
            Player::Agent(agent) => self.ask(&agent)?,
            Player::Expert if !self.expert_is_in => return Err(WebError::LateExpert),
            Player::Expert => {
                self.agent_memory = None;
                let batch = Batch::new(self.pool.layout(), &self.blocks);
                self.expert.act(batch.features(), batch.vector_observation(), &mut self.action);
            }
            Player::Trace => {
                let played = self.length();
                let (trace, number) = self.script.as_mut().ok_or(WebError::NoScript)?;
                match trace.episodes[*number].steps.get(played) {
                    Some(step) => self.action.clone_from(&step.action),
                    None => {
                        let next = trace.episodes.get(*number + 1).ok_or(WebError::ScriptIsOver)?;
                        let seed = next.seed;
                        *number += 1;
                        return self.reset(seed);
                    }
                }
                (self.expert_is_in, self.agent_memory) = (false, None);
            }
        }
        self.pool.step(&self.action, &mut self.blocks)?;
        self.recorder.step(&self.action, &self.pool, &self.blocks);
        self.observe()
    }

    /// Lets the agent choose the action.
    fn ask(&mut self, agent: &Agent) -> Result<(), WebError> {
        let spec = self.pool.spec();
        if !agent.fits(spec) {
            return Err(WebError::OtherAgent { trained: agent.env().to_owned(), played: spec.id });
        }
        if self.length() == 0 && self.agent_memory.is_none() {
            self.agent_memory = Some(agent.memory(self.seed.unwrap_or(0)));
        }
        let memory = self.agent_memory.as_mut().ok_or(WebError::LateAgent)?;
        self.expert_is_in = false;
        agent.act(Batch::new(self.pool.layout(), &self.blocks).features(), memory, &mut self.action);
        Ok(())
    }

    /// Updates clues and pictures after a reset or step.
    fn observe(&mut self) -> Result<(), WebError> {
        self.clues.observe(Batch::new(self.pool.layout(), &self.blocks).features());
        self.draw()
    }

    /// The environment id.
    pub fn id(&self) -> &'static str {
        self.pool.spec().id
    }

    /// Steps of the episode.
    fn length(&self) -> usize {
        self.batch().episode_length()[0] as usize
    }

    /// Draws both pictures. Call it once per step, since each call advances the clue's picture in the ground-truth
    /// view.
    fn draw(&mut self) -> Result<(), WebError> {
        put_view(&self.pool.ground_truth_view(0)?, &mut self.view);
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        put_observation(batch.observation(), &mut self.observation, SCREEN);
        Ok(())
    }

    /// The observation, 84x84 RGBA.
    pub fn observation(&self) -> &[u8] {
        &self.observation
    }

    /// The ground-truth view, 84x84 RGBA.
    pub fn view(&self) -> &[u8] {
        &self.view
    }

    /// The recording, as a trace file.
    pub fn file(&self) -> Result<Vec<u8>, WebError> {
        let mut file = Vec::new();
        self.recorder.write(&mut file)?;
        Ok(file)
    }

    /// The episode's state, which the page shows next to the pictures.
    pub fn state(&self) -> Result<Json, WebError> {
        let batch = self.batch();
        let done = batch.terminated()[0] == 1;
        let columns = self.pool.spec().info.iter().zip(batch.info());
        let info: Map<String, Json> = columns.map(|(column, value)| (column.name.to_owned(), json!(value))).collect();
        let options: Map<String, Json> =
            self.options.iter().map(|(name, value)| (name.clone(), value.to_string().into())).collect();
        let recording = self.script.as_ref().map(|(trace, number)| {
            let steps = trace.episodes[*number].steps.len();
            let over = self.length() >= steps && number + 1 == trace.episodes.len();
            json!({"episode": number, "episodes": trace.episodes.len(), "steps": steps, "over": over})
        });
        Ok(json!({
            "id": self.pool.spec().id,
            "options": options,
            // As text, since JavaScript numbers cannot hold 64-bit integers.
            "seed": self.seed.map(|seed| seed.to_string()),
            "length": self.length(),
            "reward": batch.reward()[0],
            "return": batch.episode_return()[0],
            "done": done,
            "info": done.then_some(info),
            "progress": self.pool.progress(0)?,
            "clues": self.clues.shown(),
            "action": self.action,
            "vector": batch.vector_observation(),
            "recording": recording,
        }))
    }
}
