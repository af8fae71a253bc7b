//! Concentration: turn over two cards at a time, and find the pairs.

use endless_gym_core::envs::{
    ActionSpace, EnvSpec, Expert, ObservationSpace, Parameter, ParameterError, ResetParameters, StatePart, StateSpace,
    Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::{Canvas, Rect};
use serde::{Deserialize, Serialize};

use crate::deck::{DECK, DECKS, Deck, Face, decks};
use crate::ids::{INTEGER_ZERO, levels, numbered, shape};
use crate::pictures;

const ARGUMENTS: &[Parameter] =
    &[DECKS, Parameter::choice("deck_type", "ranks", &["colors", "ranks"], "what makes two cards a pair")];

/// Number of decks, what makes a pair, the length of an episode, and the rewards.
pub struct Parameters {
    decks: usize,
    face: Face,
    length: u32,
    pair: f64,
    failure: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Concentration {
    deck: Deck,
    /// What the observation shows of each card.
    view: Vec<u8>,
    /// Whether each card's pair was found.
    found: Vec<bool>,
    /// The card that waits for a second one.
    first: Option<u16>,
    /// The one or two cards that the last step showed.
    shown: [u16; 2],
    steps: u32,
}

impl Concentration {
    fn is_found(&self, card: u16) -> bool {
        self.found[usize::from(card)]
    }

    fn face(&self, card: u16) -> u8 {
        self.deck.cards()[usize::from(card)]
    }

    /// What the observation shows of a card.
    fn shows(&self, card: u16, face: Face) -> u8 {
        let is_shown = self.is_found(card) || self.steps > 0 && self.shown.contains(&card);
        if is_shown { self.face(card) } else { face.count() as u8 }
    }

    /// Whether the cards that were found are pairs, and those that are shown follow from the last actions.
    fn are_pairs(&self, face: Face) -> bool {
        let found = |of| (0..self.view.len() as u16).filter(move |card| self.is_found(*card) && self.face(*card) == of);
        let ([first, second], is_found) = (self.shown, self.shown.map(|card| self.is_found(card)));
        let is_pair = first != second && self.face(first) == self.face(second);
        (0..face.count() as u8).all(|of| found(of).count() % 2 == 0)
            && match self.first {
                Some(waiting) => self.steps > 0 && self.shown == [waiting; 2] && !is_found[0],
                None if self.steps == 0 => self.shown == [0; 2],
                // The first of two cards that differ was not found before, so it was found with the second.
                None => first == second || if is_found[0] { is_pair && is_found[1] } else { !is_pair || is_found[1] },
            }
    }
}

impl Task for Concentration {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        let summary = "Turn over two cards at a time, and find the pairs";
        EnvSpec {
            needs_previous_action: true,
            types: INTEGER_ZERO,
            arguments: ARGUMENTS,
            ..EnvSpec::new("Concentration", summary, ActionSpace::Discrete(1))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["deck_type=colors", "num_decks=2&deck_type=colors", ""])
    }

    fn with_arguments(spec: EnvSpec, &Parameters { decks, face, .. }: &Parameters) -> Result<EnvSpec, ParameterError> {
        let description = match face {
            Face::Colour => "the card's colour, 0 or 1; 2 if it is face down",
            _ => "the card's rank, 0 to 12; 13 if it is face down",
        };
        let cards = decks * DECK;
        let faces = vec![face.count() as i32 + 1; cards].leak();
        let deck = shape(&[cards]);
        let turned = "a card that the last step showed; without one the number of faces";
        let state = vec![
            StatePart::integers("faces", face.count() as i32, deck, "int64", "the cards' colours or ranks"),
            StatePart {
                name: "found",
                description: "1 for cards of found pairs",
                space: StateSpace::Binary,
                shape: deck,
                dtype: "int8",
            },
            StatePart::integer("first", cards as i32, turned),
            StatePart::integer("second", cards as i32, turned),
        ];
        Ok(EnvSpec {
            action_space: ActionSpace::Discrete(cards as i32),
            features: numbered("card", cards, description),
            markov_state: state.leak(),
            observation_space: Some(ObservationSpace::MultiDiscrete(faces)),
            ..spec
        })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (decks, face) = (decks(given), Face::chosen(given));
        let cards = (decks * DECK) as f64;
        let length = (2.0 * cards - cards / (2.0 * cards - 1.0)).ceil();
        Parameters { decks, face, length: length as u32, pair: 1.0 / (cards / 2.0), failure: -1.0 / length }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.deck.shuffle(parameters.decks, parameters.face, random);
        self.view.clear();
        self.view.resize(self.deck.cards().len(), parameters.face.count() as u8);
        self.found.clear();
        self.found.resize(self.deck.cards().len(), false);
        (self.first, self.shown, self.steps) = (None, [0; 2], 0);
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let card = action[0] as u16;
        let first = self.first.take();
        for card in self.shown {
            if !self.is_found(card) {
                self.view[usize::from(card)] = parameters.face.count() as u8;
            }
        }
        self.shown = [first.unwrap_or(card), card];
        for card in self.shown {
            self.view[usize::from(card)] = self.deck.cards()[usize::from(card)];
        }
        let is_found = self.is_found(card);
        self.steps = self.steps.saturating_add(1);
        let (mut reward, mut terminated) = (0.0, false);
        match first {
            None if is_found => reward = parameters.failure,
            None => self.first = Some(card),
            Some(first) => {
                let is_pair = self.view[usize::from(first)] == self.view[usize::from(card)];
                if is_pair && !is_found && first != card {
                    [first, card].iter().for_each(|card| self.found[usize::from(*card)] = true);
                    reward = parameters.pair;
                    // As in the original, a step after the end is not another end.
                    terminated = !self.found.contains(&false);
                } else {
                    reward = 2.0 * parameters.failure;
                }
            }
        }
        Transition { reward, terminated, truncated: self.steps >= parameters.length }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        for (out, card) in out.iter_mut().zip(&self.view) {
            *out = (*card).into();
        }
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        let cards = self.deck.cards();
        let (faces, rest) = out.split_at_mut(cards.len());
        let (found, turned) = rest.split_at_mut(cards.len());
        faces.iter_mut().zip(cards).for_each(|(out, card)| *out = (*card).into());
        found.iter_mut().zip(&self.found).for_each(|(out, found)| *out = (*found).into());
        let [first, second] = self.shown;
        let none = parameters.face.count() as u16;
        let shown = match self.first {
            None if self.steps == 0 => [none; 2],
            // A card of a found pair ends its turn at once.
            None if first != second || !self.is_found(first) => [first, second],
            _ => [first, none],
        };
        turned.copy_from_slice(&shown.map(f32::from));
    }

    fn paint(&self, parameters: &Parameters, canvas: &mut Canvas<'_>) {
        pictures::table(canvas);
        // Cards of more than two decks are small, and lie on each other.
        let (columns, height) = [(8, 12), (12, 9)].get(parameters.decks - 1).copied().unwrap_or((20, 4));
        let width = 84 / columns;
        for (number, shown) in (0..).zip(&self.view) {
            let place = Rect::new(number % columns * width + 1, number / columns * height + 1, width - 1, height - 1);
            match usize::from(*shown) < parameters.face.count() {
                true => pictures::card(canvas, place, parameters.face, *shown),
                false => pictures::back(canvas, place, false),
            }
        }
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        let cards = parameters.decks * DECK;
        self.deck.is_valid(parameters.decks, parameters.face, None)
            && self.found.len() == cards
            && self.found.iter().filter(|found| **found).count() <= self.steps as usize
            && self.shown.into_iter().all(|card| usize::from(card) < cards)
            && self.view.iter().copied().eq((0..cards as u16).map(|card| self.shows(card, parameters.face)))
            && self.are_pairs(parameters.face)
    }

    fn expert(_: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Memory::default()))
    }
}

/// Remembers every card. Completes pairs that it knows, and otherwise turns over a card that it does not know.
#[derive(Default)]
struct Memory {
    /// The face of each card that was seen.
    known: Vec<Option<i32>>,
    /// Whether each card's pair was found.
    found: Vec<bool>,
    /// The cards of this turn.
    turned: Vec<usize>,
}

impl Memory {
    /// The card that makes a pair with this one, if it is known.
    fn partner(&self, of: usize) -> Option<usize> {
        let face = self.known[of]?;
        (0..self.known.len()).find(|card| *card != of && !self.found[*card] && self.known[*card] == Some(face))
    }

    fn choose(&self) -> Option<usize> {
        let cards = 0..self.known.len();
        let pair = match self.turned.first() {
            Some(first) => self.partner(*first),
            None => cards.clone().find(|card| !self.found[*card] && self.partner(*card).is_some()),
        };
        pair.or_else(|| cards.clone().find(|card| self.known[*card].is_none()))
    }
}

impl Expert for Memory {
    fn reset(&mut self) {
        *self = Memory::default();
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        self.known.resize(features.len(), None);
        self.found.resize(features.len(), false);
        for card in &self.turned {
            self.known[*card] = Some(features[*card] as i32);
        }
        if let [first, second] = self.turned[..] {
            if self.known[first] == self.known[second] {
                (self.found[first], self.found[second]) = (true, true);
            }
            self.turned.clear();
        }
        let card = self.choose().unwrap_or_default();
        self.turned.push(card);
        action[0] = card as i32;
    }
}
