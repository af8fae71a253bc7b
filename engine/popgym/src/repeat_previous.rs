//! Repeat Previous: name the suit of the card that was shown some steps ago.

use std::collections::VecDeque;

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, Parameter, ParameterError, ResetParameters, StatePart,
    Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::Canvas;
use serde::{Deserialize, Serialize};

use crate::deck::{DECK, DECKS, Deck, Face, decks};
use crate::ids::{INTEGER_ZERO, SUITS, levels, shape};
use crate::pictures::{self, ALONE};

const ARGUMENTS: &[Parameter] =
    &[DECKS, Parameter::int("k", 4, 1, 3275, "which card to name: 1 is the one that is shown")];

/// Number of decks, which card to name, and the reward.
pub struct Parameters {
    decks: usize,
    k: usize,
    reward: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RepeatPrevious {
    deck: Deck,
    card: u8,
}

impl Task for RepeatPrevious {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[Column { name: "suit", description: "the suit of the card, 0 to 3" }];
        let summary = "Name the suit of the card that was shown some steps ago";
        EnvSpec {
            actions: SUITS,
            features: FEATURES,
            observation_space: Some(ObservationSpace::Discrete(4)),
            types: INTEGER_ZERO,
            arguments: ARGUMENTS,
            ..EnvSpec::new("RepeatPrevious", summary, ActionSpace::Discrete(4))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["", "num_decks=2&k=32", "num_decks=3&k=64"])
    }

    fn with_arguments(spec: EnvSpec, parameters: &Parameters) -> Result<EnvSpec, ParameterError> {
        let Parameters { decks, k, .. } = *parameters;
        if k >= decks * DECK {
            let allowed = format!("less than the number of cards, {}", decks * DECK);
            return Err(ParameterError::Argument { name: "k", value: k.to_string(), allowed });
        }
        let suits = "the last suits that were shown, the oldest first; 0 before the first card";
        let state = vec![
            StatePart::integers("suits", 4, shape(&[k]), "int64", suits),
            StatePart::shares("left", &[4], "share of the cards of each suit that has not been dealt"),
        ];
        Ok(EnvSpec { markov_state: state.leak(), ..spec })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (decks, k) = (decks(given), given.int("k", 1) as usize);
        Parameters { decks, k, reward: 1.0 / ((decks * DECK) as f64 - k as f64) }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.deck.shuffle(parameters.decks, Face::Suit, random);
        self.card = self.deck.deal();
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let reward = match self.deck.dealt(parameters.k - 1) {
            Some(suit) if action[0] == i32::from(suit) => parameters.reward,
            Some(_) => -parameters.reward,
            None => 0.0,
        };
        let terminated = self.deck.left() <= 1;
        self.card = self.deck.deal();
        Transition { reward, terminated, truncated: false }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = self.card.into();
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        let (suits, left) = out.split_at_mut(parameters.k);
        for (ago, out) in suits.iter_mut().rev().enumerate() {
            *out = self.deck.dealt(ago).unwrap_or_default().into();
        }
        let each = (parameters.decks * DECK) as f64 / 4.0;
        self.deck.write_dealt(left, |face| face, |count| 1.0 - count / each);
    }

    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        pictures::table(canvas);
        pictures::card(canvas, ALONE, Face::Suit, self.card);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        self.deck.is_valid(parameters.decks, Face::Suit, Some(self.card))
    }

    fn expert(&Parameters { k, .. }: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Memory { k, suits: VecDeque::with_capacity(k + 1) }))
    }
}

/// Remembers the last `k` suits.
struct Memory {
    k: usize,
    suits: VecDeque<i32>,
}

impl Expert for Memory {
    fn reset(&mut self) {
        self.suits.clear();
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        self.suits.push_back(features[0] as i32);
        action[0] = if self.suits.len() < self.k { 0 } else { self.suits.pop_front().unwrap_or_default() };
    }
}
