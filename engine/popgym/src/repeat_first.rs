//! Repeat First: name the suit of the first card, step after step.

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, ResetParameters, StatePart, Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use serde::{Deserialize, Serialize};

use crate::deck::{DECK, DECKS, Deck, Face, decks};
use crate::ids::{SUITS, levels};
use crate::pictures::{self, ALONE};

/// Number of decks, and the reward.
pub struct Parameters {
    decks: usize,
    reward: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RepeatFirst {
    deck: Deck,
    first: u8,
    card: u8,
}

impl Task for RepeatFirst {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[Column { name: "suit", description: "the suit of the card, 0 to 3" }];
        const STATE: &[StatePart] = &[
            StatePart::integers("first", 4, &[], "int64", "the suit of the first card, 0 to 3"),
            StatePart::shares("left", &[4], "share of the cards of each suit that has not been dealt"),
        ];
        let summary = "Name the suit of the first card";
        EnvSpec {
            actions: SUITS,
            features: FEATURES,
            observation_space: Some(ObservationSpace::Discrete(4)),
            markov_state: STATE,
            arguments: &[DECKS],
            ..EnvSpec::new("RepeatFirst", summary, ActionSpace::Discrete(4))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["", "num_decks=8", "num_decks=16"])
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let decks = decks(given);
        Parameters { decks, reward: 1.0 / (decks * DECK - 1) as f64 }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.deck.shuffle(parameters.decks, Face::Suit, random);
        self.first = self.deck.deal();
        self.card = self.first;
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let reward = if action[0] == i32::from(self.first) { parameters.reward } else { -parameters.reward };
        let terminated = self.deck.left() <= 1;
        self.card = self.deck.deal();
        Transition { reward, terminated, truncated: false }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = self.card.into();
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        out[0] = self.first.into();
        let each = (parameters.decks * DECK) as f64 / 4.0;
        self.deck.write_dealt(&mut out[1..], |face| face, |count| 1.0 - count / each);
    }

    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        pictures::table(canvas);
        pictures::card(canvas, ALONE, Face::Suit, self.card);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        self.deck.is_valid(parameters.decks, Face::Suit, Some(self.card))
            && self.deck.cards().last() == Some(&self.first)
    }

    fn expert(_: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Memory::default()))
    }
}

/// Repeats the first card.
#[derive(Default)]
struct Memory {
    first: Option<i32>,
}

impl Expert for Memory {
    fn reset(&mut self) {
        self.first = None;
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        action[0] = *self.first.get_or_insert(features[0] as i32);
    }
}
