//! Higher Lower: guess whether the next card has a higher or a lower rank.

use endless_gym_core::envs::{
    ActionBranch, ActionSpace, Choice, Column, EnvSpec, Expert, ObservationSpace, ResetParameters, StatePart, Task,
    Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use serde::{Deserialize, Serialize};

use crate::deck::{DECK, DECKS, Deck, Face, decks};
use crate::ids::{INTEGER_ZERO, levels};
use crate::pictures::{self, ALONE};

const HIGHER: i32 = 0;
const LOWER: i32 = 1;

/// Number of decks, and the reward.
pub struct Parameters {
    decks: usize,
    reward: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct HigherLower {
    deck: Deck,
    card: u8,
}

impl HigherLower {
    fn rank(&self) -> u8 {
        self.card / 4
    }
}

impl Task for HigherLower {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const ACTIONS: &[ActionBranch] = &[ActionBranch {
            name: "guess",
            choices: &[
                Choice { name: "higher", description: "guesses that the next card has a higher rank" },
                Choice { name: "lower", description: "guesses that the next card has a lower rank" },
            ],
        }];
        const FEATURES: &[Column] =
            &[Column { name: "rank", description: "the rank of the card, from 0, the ace, to 12, the king" }];
        const GROUND_TRUTH: &[Column] =
            &[Column { name: "suit", description: "the suit of the card: spades, diamonds, clubs, hearts" }];
        const STATE: &[StatePart] =
            &[StatePart::shares("dealt", &[13], "share of the cards of each rank that has been dealt")];
        let summary = "Guess whether the next card has a higher or a lower rank";
        EnvSpec {
            actions: ACTIONS,
            features: FEATURES,
            observation_space: Some(ObservationSpace::Discrete(13)),
            ground_truth: GROUND_TRUTH,
            ground_truth_is_integer: true,
            markov_state: STATE,
            types: INTEGER_ZERO,
            arguments: &[DECKS],
            ..EnvSpec::new("HigherLower", summary, ActionSpace::Discrete(2))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["", "num_decks=2", "num_decks=3"])
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let decks = decks(given);
        Parameters { decks, reward: 1.0 / (decks * DECK) as f64 }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.deck.shuffle(parameters.decks, Face::Card, random);
        self.card = self.deck.deal();
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let terminated = self.deck.left() <= 1;
        let rank = self.rank();
        self.card = self.deck.deal();
        let reward = if self.rank() == rank {
            0.0
        } else if (self.rank() > rank) == (action[0] == HIGHER) {
            parameters.reward
        } else {
            -parameters.reward
        };
        Transition { reward, terminated, truncated: false }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = self.rank().into();
    }

    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        pictures::table(canvas);
        pictures::card(canvas, ALONE, Face::Rank, self.rank());
    }

    fn ground_truth(&self, _: &Parameters, out: &mut [f64]) {
        out[0] = (self.card % 4).into();
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        self.deck.write_dealt(out, |card| card / 4, |count| count / 4.0 / parameters.decks as f64);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        self.deck.is_valid(parameters.decks, Face::Card, Some(self.card))
    }

    fn expert(parameters: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Counts { left: [0; 13], decks: parameters.decks as i32 }))
    }
}

/// Counts the cards that are left. The guess that more of them confirm is the best.
struct Counts {
    left: [i32; 13],
    decks: i32,
}

impl Expert for Counts {
    fn reset(&mut self) {
        self.left = [4 * self.decks; 13];
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        let rank = features[0] as usize;
        self.left[rank] -= 1;
        let lower: i32 = self.left[..rank].iter().sum();
        let higher: i32 = self.left[rank + 1..].iter().sum();
        action[0] = if lower > higher { LOWER } else { HIGHER };
    }
}
