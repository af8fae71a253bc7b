//! One environment that a person, an expert, an agent or a trace plays, with a recording.

use std::rc::Rc;

use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::envs::Expert;
use endless_gym_core::pool::{
    Autoreset, NoExpert, OptionMap, Pool, PoolConfig, Registry, ResetOptions, ResetRequest, Seeding, Threads,
};
use endless_gym_core::trace::{Recorder, Trace};
use serde_json::{Map, Value as Json, json};

use crate::agent::{Agent, Memory};
use crate::clues::Clues;
use crate::error::WebError;
use crate::pixels::{put_observation, put_view};

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
    /// The scripted expert, if there is one.
    expert: Option<Box<dyn Expert>>,
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
    pub fn start(registry: &Registry, id: &str, options: OptionMap, seed: u64) -> Result<Self, WebError> {
        Self::new(registry, id, options, Some(seed), None)
    }

    /// Starts the first episode of a trace.
    pub fn replay(registry: &Registry, trace: Trace) -> Result<Self, WebError> {
        let (id, options) = (trace.env.clone(), trace.options.clone());
        let seed = trace.episodes.first().and_then(|episode| episode.seed);
        Self::new(registry, &id, options, seed, Some((trace, 0)))
    }

    fn new(
        registry: &Registry,
        id: &str,
        options: OptionMap,
        seed: Option<u64>,
        script: Option<(Trace, usize)>,
    ) -> Result<Self, WebError> {
        let spec = registry.spec(id)?;
        if registry.specs().all(|known| known.id != spec.id) {
            return Err(WebError::Arguments { id: spec.id });
        }
        let config = PoolConfig::new(id, 1)
            .options(ResetOptions::Shared(options.clone()))
            .autoreset(Autoreset::Disabled)
            .seeding(Seeding::Continue { seed: Some(0) })
            .features(!spec.features.is_empty());
        let pool = Pool::new(registry, &config, &Threads::new(1)?)?;
        let blocks = zeroed(pool.layout().blocks());
        let rgba = pool.spec().shown().map_or(0, |frame| frame.width * frame.height * 4);
        let mut game = Game {
            expert: registry.expert(id).ok(),
            expert_is_in: true,
            agent_memory: None,
            clues: Clues::new(pool.spec()),
            action: vec![0; pool.spec().action_space.width()],
            recorder: Recorder::new(spec.id, &options),
            pool,
            blocks,
            options,
            seed,
            script,
            observation: vec![0; rgba],
            view: vec![0; rgba],
        };
        game.reset(seed)?;
        game.draw()?;
        Ok(game)
    }

    fn reset(&mut self, seed: Option<u64>) -> Result<(), WebError> {
        self.seed = seed;
        match seed {
            Some(seed) => self.pool.reset(ResetRequest::Seed(seed), &mut self.blocks)?,
            None => self.pool.reset(ResetRequest::All, &mut self.blocks)?,
        }
        self.recorder.reset(seed, &self.pool, &self.blocks);
        self.expert.iter_mut().for_each(|expert| expert.reset());
        self.expert_is_in = true;
        self.agent_memory = None;
        self.clues.reset();
        self.action.fill(0);
        self.remember()
    }

    fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }

    /// Plays one step. After the last step of a trace's episode, a trace step starts the next episode.
    pub fn step(&mut self, player: Player) -> Result<(), WebError> {
        self.advance(player)?;
        self.draw()
    }

    /// Lets the agent play so many steps or to the episode's end, and draws only the last one.
    pub fn play_out(&mut self, agent: &Rc<Agent>, most: usize) -> Result<(), WebError> {
        for _ in 0..most {
            if self.batch().has_ended(0) {
                break;
            }
            self.advance(Player::Agent(Rc::clone(agent)))?;
        }
        self.draw()
    }

    fn advance(&mut self, player: Player) -> Result<(), WebError> {
        match player {
            Player::Person(action) => {
                (self.expert_is_in, self.agent_memory) = (false, None);
                self.action = action;
            }
            Player::Agent(agent) => self.ask(&agent)?,
            Player::Expert if !self.expert_is_in => return Err(WebError::LateExpert),
            Player::Expert => {
                let id = self.pool.spec().id.to_owned();
                let expert = self.expert.as_mut().ok_or(NoExpert { id })?;
                self.agent_memory = None;
                let batch = Batch::new(self.pool.layout(), &self.blocks);
                expert.act(batch.features(), batch.vector_observation(), &mut self.action);
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
        self.remember()
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

    /// Updates the clues after a reset or step.
    fn remember(&mut self) -> Result<(), WebError> {
        let collected =
            self.pool.progress(0)?.iter().find(|progress| progress.name == "coins").map_or(0.0, |coins| coins.value);
        let spec = self.pool.spec();
        let right =
            spec.actions.first().and_then(|branch| branch.choices.iter().position(|choice| choice.name == "right"));
        let is_right = self.length() > 0 && right == self.action.first().map(|number| *number as usize);
        let speed = match self.options.get("agent_speed").and_then(Json::as_f64) {
            Some(given) => given,
            None => spec
                .parameters
                .iter()
                .find(|parameter| parameter.name == "agent_speed")
                .map_or(0.0, |parameter| parameter.default_text().parse().unwrap_or(0.0)),
        };
        let moved = if is_right { speed / spec.frame.map_or(1.0, |frame| frame.width as f64) } else { 0.0 };
        self.clues.observe(Batch::new(self.pool.layout(), &self.blocks).features(), collected, moved as f32);
        Ok(())
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
        let Some(shape) = self.pool.spec().shown() else { return Ok(()) };
        put_view(&self.pool.ground_truth_view(0)?, shape, &mut self.view);
        let drawn = if self.pool.spec().frame.is_none() { self.pool.frame(0)? } else { Vec::new() };
        let batch = Batch::new(self.pool.layout(), &self.blocks);
        let picture = if drawn.is_empty() { batch.observation() } else { &drawn };
        put_observation(picture, shape, &mut self.observation, shape.width);
        Ok(())
    }

    /// The observation, RGBA of the frame's size.
    pub fn observation(&self) -> &[u8] {
        &self.observation
    }

    /// The ground-truth view, RGBA of the frame's size.
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
        let done = batch.has_ended(0);
        let columns = self.pool.spec().info.iter().zip(batch.info());
        let info: Map<String, Json> = columns.map(|(column, value)| (column.name.to_owned(), json!(value))).collect();
        let recording = self.script.as_ref().map(|(trace, number)| {
            let steps = trace.episodes[*number].steps.len();
            let over = self.length() >= steps && number + 1 == trace.episodes.len();
            json!({"episode": number, "episodes": trace.episodes.len(), "steps": steps, "over": over})
        });
        Ok(json!({
            "id": self.pool.spec().id,
            "options": texts(&self.options),
            // As text, since JavaScript numbers cannot hold 64-bit integers.
            "seed": self.seed.map(|seed| seed.to_string()),
            "length": self.length(),
            "reward": batch.reward()[0],
            "return": batch.episode_return()[0],
            "done": done,
            "info": done.then_some(info),
            "progress": self.pool.progress(0)?,
            "clues": self.clues.seen(),
            "action": self.action,
            "vector": batch.vector_observation(),
            // Shown if there is no picture.
            "features": self.pool.spec().shown().is_none().then(|| batch.features()),
            "recording": recording,
        }))
    }
}

/// Reset parameters as the texts of the page's form.
pub fn texts(options: &OptionMap) -> Map<String, Json> {
    options.iter().map(|(name, value)| (name.clone(), value.to_string().into())).collect()
}
