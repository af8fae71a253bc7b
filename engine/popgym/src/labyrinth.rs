//! Labyrinth Escape and Labyrinth Explore: walk through a maze, seeing only the squares around.

use std::collections::HashSet;

use endless_gym_core::envs::{
    ActionBranch, ActionSpace, Choice, Column, EnvSpec, Expert, ObservationSpace, OriginalTypes, Parameter,
    ParameterError, ParameterKind, ResetParameters, RewardType, StatePart, Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::{Canvas, Rect};
use serde::{Deserialize, Serialize};

use crate::ids::{levels, numbered, shape};
use crate::maze::{Maze, Place, connected};
use crate::pictures;

const ARGUMENTS: &[Parameter] = &[
    Parameter::list("maze_dims", &[10, 10], 6, 62, "height and width of the maze, two even numbers"),
    Parameter::int("episode_length", 1024, 1, i32::MAX as i64, "one more than the steps of an episode; 1 for no limit"),
];
/// Cells of the observation.
const VIEW: usize = 9;
/// The last action, before the first.
const NONE: u8 = 4;

const FREE: f32 = 0.0;
const WALL: f32 = 1.0;
const START: f32 = 2.0;
const GOAL: f32 = 3.0;
const HIDDEN: f32 = 4.0;

/// The maze's rows and columns of cells, between walls, the agent's task, the length of an episode, and the reward of a step.
pub struct Parameters {
    cells: [usize; 2],
    escapes: bool,
    length: u32,
    step: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Labyrinth {
    maze: Maze,
    position: Place,
    /// Squares that the agent has been on, as bits of rows.
    explored: Vec<u64>,
    /// Squares that are no wall and have not been explored.
    left: u32,
    /// Reward for a new square.
    reward: f64,
    action: u8,
    steps: u32,
}

impl Labyrinth {
    /// The square in a direction; the agent's own square if that is a wall or outside.
    fn moved(&self, action: i32, escapes: bool) -> Place {
        let Place { row, column } = self.position;
        let [rows, columns] = self.maze.size();
        let to = match action {
            0 => Place { row, column: column.saturating_sub(1) },
            1 => Place { row, column: (columns - 1).min(column + 1) },
            2 => Place { row: row.saturating_sub(1), column },
            _ => Place { row: (rows - 1).min(row + 1), column },
        };
        if self.square(to, escapes) == WALL { self.position } else { to }
    }

    fn square(&self, place: Place, escapes: bool) -> f32 {
        if escapes && place == self.maze.goal {
            GOAL
        } else if place == self.maze.start {
            START
        } else if self.maze.is_wall(place) {
            WALL
        } else {
            FREE
        }
    }

    /// Marks the agent's square as explored. Returns whether it was new.
    fn explore(&mut self) -> bool {
        let Place { row, column } = self.position;
        let is_new = self.explored[row] >> column & 1 == 0;
        self.explored[row] |= 1 << column;
        self.left = self.left.saturating_sub(is_new.into());
        is_new
    }

    /// Whether the agent can have explored these squares of a valid maze, and be where it is.
    fn is_explored(&self, escapes: bool) -> bool {
        let mut ways = self.maze.ways();
        for way in [Some(self.maze.start), escapes.then_some(self.maze.goal)].into_iter().flatten() {
            ways[way.row] |= 1 << way.column;
        }
        let explored = self.explored.iter().map(|row| row.count_ones()).sum();
        let Place { row, column } = self.position;
        self.explored.len() == ways.len()
            && self.explored.iter().zip(&ways).all(|(explored, ways)| explored & !ways == 0)
            && connected(&self.explored, self.maze.start) == self.explored
            && row < ways.len()
            && column < self.maze.size()[1]
            && self.explored[row] >> column & 1 == 1
            && explored <= self.steps.saturating_add(1)
            && self.left == (self.maze.free() + 1).saturating_sub(explored)
    }
}

impl Task for Labyrinth {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const ACTIONS: &[ActionBranch] = &[ActionBranch {
            name: "move",
            choices: &[
                Choice { name: "left", description: "walks one square to the left, unless there is a wall" },
                Choice { name: "right", description: "walks one square to the right" },
                Choice { name: "up", description: "walks one square up" },
                Choice { name: "down", description: "walks one square down" },
            ],
        }];
        const GROUND_TRUTH: &[Column] = &[
            Column { name: "x", description: "column of the agent, from 0 on the left" },
            Column { name: "y", description: "row of the agent, from 0 at the top" },
        ];
        const SPACE: ObservationSpace = ObservationSpace::MultiDiscrete(&[5; VIEW + 1]);
        let squares = "a square around the agent, row by row: 0 free, 1 wall, 2 start, 3 exit; at the left and the upper border, the \
                       view has only two columns or rows, followed by walls";
        let action = Column { name: "action", description: "the last action, 0 to 3; at first 4" };
        let summary = "Find the exit of a maze, seeing only the squares around";
        EnvSpec {
            needs_previous_action: true,
            types: OriginalTypes { integers: "int32", ..OriginalTypes::DEFAULT },
            actions: ACTIONS,
            features: [numbered("square", VIEW, squares), &[action]].concat().leak(),
            observation_space: Some(SPACE),
            ground_truth: GROUND_TRUTH,
            ground_truth_is_integer: true,
            arguments: ARGUMENTS,
            ..EnvSpec::new("LabyrinthEscape", summary, ActionSpace::Discrete(4))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        let escape = Self::spec();
        let explore = EnvSpec {
            id: "LabyrinthExplore",
            summary: "Explore a maze, seeing only the squares around",
            types: OriginalTypes { reward: RewardType::NumpyFloatIfPositive, ..escape.types },
            ..escape.clone()
        };
        [escape, explore].map(|spec| levels::<Self>(spec, ["", "maze_dims=14,14", "maze_dims=18,18"])).concat()
    }

    fn with_arguments(spec: EnvSpec, parameters: &Parameters) -> Result<EnvSpec, ParameterError> {
        if let ParameterKind::IntList { default, .. } = spec.arguments[0].kind
            && (default.len() != 2 || default.iter().any(|size| size % 2 == 1))
        {
            let (value, allowed) = (format!("{default:?}"), "two even numbers, 6 to 62".to_owned());
            return Err(ParameterError::Argument { name: "maze_dims", value, allowed });
        }
        let squares = "the maze, row by row: 0 free, 1 wall, 2 start, 3 exit; 4 where the agent has not been";
        let size = shape(&parameters.cells.map(|cells| 2 * cells + 1));
        Ok(EnvSpec { markov_state: vec![StatePart::integers("maze", 5, size, "int8", squares)].leak(), ..spec })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (sizes, length) = (given.int_list("maze_dims"), given.int("episode_length", 1) as u32);
        let cells = [0, 1].map(|axis| sizes.get(axis).map_or(3, |size| *size as usize / 2));
        Parameters { cells, escapes: given.id().contains("Escape"), length, step: -1.0 / f64::from(length) }
    }

    fn seed(&mut self, seed: u64) {
        self.maze.seed(seed);
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.maze.generate(parameters.cells, random);
        self.position = self.maze.start;
        self.explored.clear();
        self.explored.resize(self.maze.size()[0], 0);
        let free = self.maze.free();
        self.reward = 1.0 / f64::from(free);
        self.left = free + 1;
        self.explore();
        (self.action, self.steps) = (NONE, 0);
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        self.position = self.moved(action[0], parameters.escapes);
        let is_new = self.explore();
        self.action = action[0] as u8;
        self.steps = self.steps.saturating_add(1);
        let (mut reward, mut terminated) = (parameters.step, false);
        if parameters.escapes && self.position == self.maze.goal {
            reward += 1.0;
            terminated = true;
        } else if !parameters.escapes {
            if is_new {
                reward = self.reward;
            }
            terminated = self.left == 0;
        }
        Transition { reward, terminated, truncated: self.steps == parameters.length - 1 }
    }

    fn features(&self, parameters: &Parameters, out: &mut [f32]) {
        let Place { row, column } = self.position;
        let (top, left) = (row.saturating_sub(1), column.saturating_sub(1));
        let [rows, columns] = self.maze.size();
        // The original confuses height and width here.
        let (bottom, right) = (rows.min(columns.min(row + 1) + 1), columns.min(rows.min(column + 1) + 1));
        for (number, out) in out[..VIEW].iter_mut().enumerate() {
            let place = Place { row: top + number / 3, column: left + number % 3 };
            *out =
                if place.row < bottom && place.column < right { self.square(place, parameters.escapes) } else { WALL };
        }
        out[VIEW] = self.action.into();
    }

    fn paint(&self, parameters: &Parameters, canvas: &mut Canvas<'_>) {
        let mut features = [0.0; VIEW + 1];
        self.features(parameters, &mut features);
        for (number, square) in (0..).zip(&features[..VIEW]) {
            let color = match *square {
                WALL => pictures::DARK,
                START => pictures::BLUE,
                GOAL => pictures::GREEN,
                _ => pictures::PAPER,
            };
            canvas.draw_rect(color, Rect::new(number % 3 * 28, number / 3 * 28, 27, 27), 0);
        }
        // An arrow of the last action.
        let ends = [(6, 42), (78, 42), (42, 6), (42, 78)];
        if let Some(end) = ends.get(usize::from(self.action)) {
            canvas.draw_line(pictures::RED, (42, 42), *end, 3);
            canvas.draw_circle(pictures::RED, *end, 4, 0);
        }
    }

    fn ground_truth(&self, _: &Parameters, out: &mut [f64]) {
        out[0] = self.position.column as f64;
        out[1] = self.position.row as f64;
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        let [_, columns] = self.maze.size();
        for (number, out) in out.iter_mut().enumerate() {
            let place = Place { row: number / columns, column: number % columns };
            let is_explored = self.explored[place.row] >> place.column & 1 == 1;
            *out = if is_explored { self.square(place, parameters.escapes) } else { HIDDEN };
        }
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        self.maze.is_valid(parameters.cells)
            && self.reward == 1.0 / f64::from(self.maze.free())
            && self.is_explored(parameters.escapes)
            && if self.steps == 0 { self.action == NONE } else { self.action < NONE }
    }

    fn expert(_: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Walker::default()))
    }
}

/// Depth-first search: walks into squares that it has not been on, first straight on, and back where there are none.
#[derive(Default)]
struct Walker {
    /// Squares that it has been on, relative to the start.
    explored: HashSet<[i32; 2]>,
    /// The actions that lead from the start to its square.
    path: Vec<i32>,
    position: [i32; 2],
}

/// Rows and columns of the actions' moves. Actions 2n and 2n + 1 are opposite.
const MOVES: [[i32; 2]; 4] = [[0, -1], [0, 1], [-1, 0], [1, 0]];

impl Expert for Walker {
    fn reset(&mut self) {
        *self = Walker::default();
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        let view = &features[..VIEW];
        self.explored.insert(self.position);
        // Only on the start can the agent be at the view's edge.
        let start = view.iter().position(|square| *square == START);
        let middle = start.filter(|_| self.path.is_empty()).unwrap_or(VIEW / 2) as i32;
        let square = |[row, column]: [i32; 2]| {
            let (row, column) = (middle / 3 + row, middle % 3 + column);
            if (0..3).contains(&row) && (0..3).contains(&column) { view[(3 * row + column) as usize] } else { WALL }
        };
        let to = |move_: i32| {
            let [row, column] = MOVES[move_ as usize];
            [self.position[0] + row, self.position[1] + column]
        };
        let last = self.path.last().copied();
        let first = last.into_iter().chain(0..4);
        let is_new = |move_: &i32| square(MOVES[*move_ as usize]) != WALL && !self.explored.contains(&to(*move_));
        let goal = (0..4).find(|move_| square(MOVES[*move_ as usize]) == GOAL);
        action[0] = match goal.or_else(|| first.into_iter().find(is_new)) {
            Some(new) => {
                self.position = to(new);
                self.path.push(new);
                new
            }
            None => match self.path.pop() {
                Some(last) => {
                    let back = last ^ 1;
                    self.position = to(back);
                    back
                }
                None => 0,
            },
        };
    }
}
