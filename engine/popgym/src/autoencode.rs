//! Autoencode: watch a deck, then name its suits in reverse order.

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, ParameterError, ResetParameters, StatePart, Task,
    Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::{Canvas, Rect};
use serde::{Deserialize, Serialize};

use crate::deck::{DECK, DECKS, Deck, Face, decks};
use crate::ids::{INTEGER_ZERO, SUITS, levels, shape};
use crate::pictures::{self, ALONE};

/// Number of decks, and the reward.
pub struct Parameters {
    decks: usize,
    reward: f64,
}

/// The state of an episode. The agent watches until all cards have been dealt.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Autoencode {
    deck: Deck,
    /// Number of suits that the agent has named.
    named: usize,
    /// The suit that is shown.
    card: u8,
}

impl Task for Autoencode {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[
            Column { name: "mode", description: "1 while the agent watches, 0 when it names suits" },
            Column { name: "suit", description: "the suit of the card, 0 to 3; 0 from the second card to name on" },
        ];
        let summary = "Watch a deck, then name its suits in reverse order";
        EnvSpec {
            actions: SUITS,
            features: FEATURES,
            observation_space: Some(ObservationSpace::Tuple(&[
                ObservationSpace::Discrete(2),
                ObservationSpace::Discrete(4),
            ])),
            types: INTEGER_ZERO,
            arguments: &[DECKS],
            ..EnvSpec::new("Autoencode", summary, ActionSpace::Discrete(4))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["", "num_decks=2", "num_decks=3"])
    }

    fn with_arguments(spec: EnvSpec, parameters: &Parameters) -> Result<EnvSpec, ParameterError> {
        let suits = "suits of the deck, 0 to 3, from the card that is dealt last";
        let state = vec![
            StatePart::integers("deck", 4, shape(&[parameters.decks * DECK]), "int64", suits),
            StatePart::integer("mode", 2, "1 while the agent watches, 0 when it names suits"),
            StatePart::shares("left", &[1], "share of the deck that has been dealt and not named"),
        ];
        Ok(EnvSpec { markov_state: state.leak(), ..spec })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let decks = decks(given);
        Parameters { decks, reward: 1.0 / (decks * DECK) as f64 }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.deck.shuffle(parameters.decks, Face::Suit, random);
        self.card = self.deck.deal();
        self.named = 0;
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        if self.deck.left() > 0 {
            self.card = self.deck.deal();
            return Transition::default();
        }
        // The last card dealt is the first of the deck. After the end, only the last remains to be named.
        let last = parameters.decks * DECK - 1;
        let named = last.min(self.named);
        let correct = action[0] == i32::from(self.deck.cards()[named]);
        let terminated = named == last;
        self.named = named + 1;
        self.card = 0;
        Transition {
            reward: if correct { parameters.reward } else { -parameters.reward },
            terminated,
            truncated: false,
        }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = if self.deck.left() > 0 { 1.0 } else { 0.0 };
        out[1] = self.card.into();
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        let cards = self.deck.cards();
        let (deck, rest) = out.split_at_mut(cards.len());
        deck.iter_mut().zip(cards).for_each(|(out, card)| *out = (*card).into());
        rest[0] = if self.deck.left() > 0 { 1.0 } else { 0.0 };
        let held = parameters.decks * DECK - self.deck.left() - self.named;
        rest[1] = (held as f64 / cards.len() as f64) as f32;
    }

    /// The band below the card says whether the agent watches (blue) or names suits (gold). A question mark covers the 0 of the latter.
    fn paint(&self, _: &Parameters, canvas: &mut Canvas<'_>) {
        pictures::table(canvas);
        let watches = self.deck.left() > 0;
        if watches || self.card > 0 {
            pictures::card(canvas, ALONE, Face::Suit, self.card);
        } else {
            pictures::back(canvas, ALONE, true);
        }
        let band = if watches { pictures::BLUE } else { pictures::GOLD };
        canvas.draw_rect(band, Rect::new(20, 77, 44, 4), 0);
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        let last = if self.named == 0 { Some(self.card) } else { self.deck.dealt(0) };
        self.deck.is_valid(parameters.decks, Face::Suit, last)
            && self.named <= parameters.decks * DECK
            && (self.named == 0 || self.deck.left() == 0 && self.card == 0)
    }

    fn expert(_: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Memory::default()))
    }
}

/// Remembers all suits.
#[derive(Default)]
struct Memory {
    suits: Vec<i32>,
    names: bool,
}

impl Expert for Memory {
    fn reset(&mut self) {
        *self = Memory::default();
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        if !self.names {
            self.suits.push(features[1] as i32);
            self.names = features[0] == 0.0;
        }
        action[0] = if self.names { self.suits.pop().unwrap_or_default() } else { 0 };
    }
}
