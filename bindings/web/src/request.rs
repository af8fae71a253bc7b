//! The page's requests, and their answers.

use std::collections::HashMap;
use std::rc::Rc;

use endless_gym_core::envs::EnvSpec;
use endless_gym_core::pool::{OptionMap, PoolConfig, Registry, ResetOptions};
use endless_gym_core::trace::{Trace, replay};
use serde::Deserialize;
use serde_json::{Map, Value as Json, json};

use crate::agent::Agent;
use crate::error::WebError;
use crate::game::{Game, Player};
use crate::group::Group;
use crate::wall::Wall;

/// The state of the page.
#[derive(Default)]
pub struct App {
    pub registry: Registry,
    pub game: Option<Game>,
    pub wall: Option<Wall>,
    /// The loaded agents by the id of their environment.
    pub agents: HashMap<String, Rc<Agent>>,
}

/// Reset parameters from a form, with text values. Text that is not JSON becomes a string, so that the engine reports
/// the allowed values.
type Options = Map<String, Json>;

#[derive(Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// The table of environments.
    Specs,
    /// Checks reset parameters.
    Check {
        id: String,
        options: Options,
    },
    /// Starts an episode.
    Start {
        id: String,
        options: Options,
        seed: String,
    },
    /// Plays a step with a person's action; the next three with that of the expert, the loaded agent or the trace.
    Step {
        action: Vec<i32>,
    },
    StepOfExpert,
    StepOfAgent,
    StepOfTrace,
    /// Lets the loaded agent play so many steps or to the episode's end, of which only the last one is drawn.
    StepsOfAgent {
        most: usize,
    },
    /// The recording of the game, as bytes.
    Save,
    /// Starts a wall.
    Wall {
        groups: Vec<WallGroup>,
        columns: usize,
        expert: bool,
        seed: String,
    },
    /// The episode that an environment of the wall plays: its id, seed and reset parameters.
    Tile {
        place: usize,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WallGroup {
    id: String,
    num_envs: usize,
    options: Options,
}

pub enum Reply {
    Json(Json),
    Bytes(Vec<u8>),
}

impl Request {
    pub fn carry_out(self, app: &mut App) -> Result<Reply, WebError> {
        let player = match self {
            Request::StepOfAgent => Player::Agent(agent(app)?),
            Request::StepsOfAgent { most } => {
                let agent = agent(app)?;
                let game = app.game.as_mut().ok_or(WebError::NoGame)?;
                game.play_out(&agent, most)?;
                return Ok(Reply::Json(game.state()?));
            }
            Request::Specs => {
                return Ok(Reply::Json(app.registry.specs().map(|entry| spec(&app.registry, entry)).collect()));
            }
            Request::Check { id, options } => {
                let options = ResetOptions::Shared(parse(&options));
                PoolConfig::new(&id, 1).options(options).validate(app.registry.spec(&id)?)?;
                return Ok(Reply::Json(Json::Null));
            }
            Request::Start { id, options, seed } => {
                let game = Game::start(&app.registry, &id, parse(&options), parse_seed(&seed)?)?;
                return Ok(Reply::Json(app.game.insert(game).state()?));
            }
            Request::Save => return Ok(Reply::Bytes(app.game.as_ref().ok_or(WebError::NoGame)?.file()?)),
            Request::Wall { groups, columns, expert, seed } => {
                let seed = parse_seed(&seed)?;
                let make = |group: &WallGroup| {
                    // Where there is no expert, actions are random.
                    let expert = expert && app.registry.expert(&group.id).is_ok();
                    Group::new(&app.registry, &group.id, group.num_envs, parse(&group.options), expert, seed)
                };
                let groups = groups.iter().map(make).collect::<Result<_, _>>()?;
                return Ok(Reply::Json(app.wall.insert(Wall::new(groups, columns)?).state()));
            }
            Request::Tile { place } => {
                return Ok(Reply::Json(app.wall.as_ref().ok_or(WebError::NoWall)?.episode(place)?));
            }
            Request::Step { action } => Player::Person(action),
            Request::StepOfExpert => Player::Expert,
            Request::StepOfTrace => Player::Trace,
        };
        let game = app.game.as_mut().ok_or(WebError::NoGame)?;
        game.step(player)?;
        Ok(Reply::Json(game.state()?))
    }
}

/// The agent of the game's environment.
fn agent(app: &App) -> Result<Rc<Agent>, WebError> {
    let id = app.game.as_ref().ok_or(WebError::NoGame)?.id();
    app.agents.get(id).map(Rc::clone).ok_or(WebError::NoAgent { id })
}

/// Sets the environments.
pub fn set_environments(app: &mut App, registry: Registry) -> Result<Reply, WebError> {
    if registry.specs().next().is_none() {
        return Err(WebError::NoEnvironments);
    }
    app.registry = registry;
    Ok(Reply::Json(Json::Null))
}

/// Replays a trace file, and makes it the game.
pub fn open(app: &mut App, file: &[u8]) -> Result<Reply, WebError> {
    let trace = Trace::read(file)?;
    let outcome = replay(&app.registry, &trace)?;
    let state = app.game.insert(Game::replay(&app.registry, trace)?).state()?;
    Ok(Reply::Json(json!({
        "episodes": outcome.episodes,
        "steps": outcome.steps,
        "views": outcome.views,
        "differences": outcome.differences,
        "first": outcome.first.map(|first| first.to_string()),
        "state": state,
    })))
}

/// Reads an agent's file. The agent can then play episodes of its environment.
pub fn load_agent(app: &mut App, file: &[u8]) -> Result<Reply, WebError> {
    let agent = Rc::new(Agent::read(file)?);
    let description = agent.description();
    app.agents.insert(agent.env().to_owned(), agent);
    Ok(Reply::Json(description))
}

pub fn step_wall(app: &mut App, count: u32) -> Result<Reply, WebError> {
    let wall = app.wall.as_mut().ok_or(WebError::NoWall)?;
    wall.step(count)?;
    Ok(Reply::Json(wall.state()))
}

/// An entry of the table, with the engine's own texts for limits and defaults.
fn spec(registry: &Registry, spec: &EnvSpec) -> Json {
    let mut value = json!(spec);
    value["shown"] = json!(spec.shown());
    value["action_branches"] = json!(spec.action_space.branches());
    value["has_expert"] = registry.expert(spec.id).is_ok().into();
    for (parameter, json) in spec.parameters.iter().zip(value["parameters"].as_array_mut().into_iter().flatten()) {
        json["default_text"] = parameter.default_text().into();
        json["allowed"] = parameter.allowed().into();
    }
    value
}

fn parse(options: &Options) -> OptionMap {
    let value = |value: &Json| match value {
        Json::String(text) => serde_json::from_str(text).unwrap_or_else(|_| value.clone()),
        other => other.clone(),
    };
    options.iter().map(|(name, text)| (name.clone(), value(text))).collect()
}

fn parse_seed(text: &str) -> Result<u64, WebError> {
    text.trim().parse().map_err(|_| WebError::Seed { given: text.to_owned() })
}
