//! Shuffled playing cards.

use endless_gym_core::envs::{Parameter, ResetParameters};
use endless_gym_core::random::Generator;
use serde::{Deserialize, Serialize};

/// What an environment sees of a card.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Face {
    /// 2 colours.
    Colour,
    /// 4 suits: spades, diamonds, clubs, hearts.
    Suit,
    /// 13 ranks, from the ace to the king.
    Rank,
    /// All 52 cards: a number of four times the rank plus the suit.
    Card,
}

/// Cards in one deck.
pub const DECK: usize = 52;

/// The argument of the number of decks. The original counts the cards of a rank in a byte.
pub const DECKS: Parameter = Parameter::int("num_decks", 1, 1, 63, "number of decks of 52 cards");

/// The number of decks.
pub fn decks(given: &ResetParameters) -> usize {
    given.int(DECKS.name, 1) as usize
}

impl Face {
    /// The face by which the argument `deck_type` tells cards apart.
    pub fn chosen(given: &ResetParameters) -> Self {
        match given.choice("deck_type") {
            "colors" => Face::Colour,
            "suits" => Face::Suit,
            _ => Face::Rank,
        }
    }

    /// Number of different faces.
    pub const fn count(self) -> usize {
        match self {
            Face::Colour => 2,
            Face::Suit => 4,
            Face::Rank => 13,
            Face::Card => DECK,
        }
    }

    /// The face of a card of a new deck, which has the four suits of each rank in a row.
    pub const fn of(self, card: usize) -> u8 {
        match self {
            Face::Colour => (card % 2) as u8,
            Face::Suit => (card % 4) as u8,
            Face::Rank => (card / 4 % 13) as u8,
            Face::Card => (card % DECK) as u8,
        }
    }
}

/// The faces of shuffled cards, which are dealt from the end.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Deck {
    cards: Vec<u8>,
    left: usize,
}

impl Deck {
    /// Shuffles this many new decks of 52 cards.
    pub fn shuffle(&mut self, decks: usize, face: Face, random: &mut Generator) {
        self.cards.clear();
        self.cards.extend((0..decks * DECK).map(|card| face.of(card)));
        random.shuffle(&mut self.cards);
        self.left = self.cards.len();
    }

    /// Deals a card; once none is left, the last one again.
    pub fn deal(&mut self) -> u8 {
        self.left = self.left.saturating_sub(1);
        self.cards[self.left]
    }

    /// The card that was dealt `ago` cards before the last one.
    pub fn dealt(&self, ago: usize) -> Option<u8> {
        self.cards.get(self.left + ago).copied()
    }

    /// Writes how many cards of each kind have been dealt, as `share(number)`.
    pub fn write_dealt(&self, out: &mut [f32], kind: impl Fn(u8) -> u8, share: impl Fn(f64) -> f64) {
        let mut counts = [0.0; DECK];
        self.cards[self.left..].iter().for_each(|card| counts[usize::from(kind(*card))] += 1.0);
        for (out, count) in out.iter_mut().zip(counts) {
            *out = share(count) as f32;
        }
    }

    /// Number of cards that have not been dealt.
    pub fn left(&self) -> usize {
        self.left
    }

    /// All cards; those that have not been dealt come first.
    pub fn cards(&self) -> &[u8] {
        &self.cards
    }

    /// Whether a restored deck consists of this many decks with such faces, and `last` was dealt last.
    pub fn is_valid(&self, decks: usize, face: Face, last: Option<u8>) -> bool {
        let count = |face| self.cards.iter().filter(|card| usize::from(**card) == face).count();
        self.cards.len() == decks * DECK
            && self.left <= self.cards.len()
            && (0..face.count()).all(|of| count(of) == self.cards.len() / face.count())
            && self.dealt(0) == last
    }
}
