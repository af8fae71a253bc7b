//! Count Recall: count the cards of each kind, and say how many of the queried kind there have been.

use endless_gym_core::envs::{
    ActionSpace, Column, EnvSpec, Expert, ObservationSpace, Parameter, ParameterError, ResetParameters, StatePart,
    Task, Transition,
};
use endless_gym_core::random::Generator;
use endless_gym_core::raster::{Canvas, Rect};
use serde::{Deserialize, Serialize};

use crate::deck::{DECK, DECKS, Deck, Face, decks};
use crate::ids::{levels, numbered, shape};
use crate::pictures;

const ARGUMENTS: &[Parameter] = &[
    DECKS,
    Parameter::float("error_clamp", 0.5, -1e9, 1e9, "without effect, as in the original"),
    Parameter::choice("deck_type", "colors", &["colors", "suits", "ranks"], "what tells cards apart"),
];
/// Most kinds of cards.
const KINDS: usize = 13;

/// Number of decks, what tells cards apart, and the reward.
pub struct Parameters {
    decks: usize,
    face: Face,
    reward: f64,
}

/// The state of an episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CountRecall {
    cards: Deck,
    queries: Deck,
    counts: [u16; KINDS],
    card: u8,
    query: u8,
}

impl CountRecall {
    fn deal(&mut self) {
        (self.card, self.query) = (self.cards.deal(), self.queries.deal());
        let count = &mut self.counts[usize::from(self.card)];
        *count = count.saturating_add(1);
    }

    /// Whether the counts are those of the cards that have been dealt.
    fn are_counted(&self) -> bool {
        let mut counts = [0; KINDS];
        self.cards.cards()[self.cards.left()..].iter().for_each(|card| counts[usize::from(*card)] += 1);
        if self.cards.left() == 0 {
            // The last card is dealt again after the end.
            let last = usize::from(self.card);
            counts[last] = self.counts[last].max(counts[last]);
        }
        counts == self.counts
    }
}

impl Task for CountRecall {
    type Parameters = Parameters;

    fn spec() -> EnvSpec {
        const FEATURES: &[Column] = &[
            Column { name: "card", description: "the kind of the card: colour, suit or rank, from 0" },
            Column { name: "query", description: "the kind whose count is asked" },
        ];
        let summary = "Count the cards of each kind, and say how many of the queried kind there have been";
        EnvSpec {
            features: FEATURES,
            ground_truth_is_integer: true,
            arguments: ARGUMENTS,
            ..EnvSpec::new("CountRecall", summary, ActionSpace::Discrete(1))
        }
    }

    fn specs() -> Vec<EnvSpec> {
        levels::<Self>(Self::spec(), ["", "num_decks=2&deck_type=suits", "num_decks=4&deck_type=ranks"])
    }

    fn with_arguments(spec: EnvSpec, &Parameters { decks, face, .. }: &Parameters) -> Result<EnvSpec, ParameterError> {
        let (kinds, each) = (face.count() as i32, shape(&[face.count()]));
        let shown = "the kinds of the card and of the query";
        let state = vec![
            StatePart::shares("dealt", each, "share of the cards of each kind that has been dealt"),
            StatePart::shares("queried", each, "share of the queries for each kind that has been asked"),
            StatePart::integers("shown", kinds, &[2], "int64", shown),
        ];
        Ok(EnvSpec {
            action_space: ActionSpace::Discrete((decks * DECK) as i32 / kinds + 1),
            markov_state: state.leak(),
            observation_space: Some(ObservationSpace::MultiDiscrete(vec![kinds; 2].leak())),
            ground_truth: numbered("counts", face.count(), "number of cards of the kind so far"),
            ..spec
        })
    }

    fn parameters(given: &ResetParameters) -> Parameters {
        let (decks, face) = (decks(given), Face::chosen(given));
        Parameters { decks, face, reward: 1.0 / (decks * DECK - 1) as f64 }
    }

    fn reset(&mut self, parameters: &Parameters, random: &mut Generator) {
        self.cards.shuffle(parameters.decks, parameters.face, random);
        self.queries.shuffle(parameters.decks, parameters.face, random);
        self.counts = [0; KINDS];
        self.deal();
    }

    fn step(&mut self, parameters: &Parameters, action: &[i32], _: &mut Generator) -> Transition {
        let correct = action[0] == i32::from(self.counts[usize::from(self.query)]);
        self.deal();
        let reward = if correct { parameters.reward } else { -parameters.reward };
        Transition { reward, terminated: self.cards.left() == 0, truncated: false }
    }

    fn features(&self, _: &Parameters, out: &mut [f32]) {
        out[0] = self.card.into();
        out[1] = self.query.into();
    }

    /// The card on the left, and on gold the kind whose count is asked.
    fn paint(&self, parameters: &Parameters, canvas: &mut Canvas<'_>) {
        pictures::table(canvas);
        pictures::card(canvas, Rect::new(4, 18, 34, 48), parameters.face, self.card);
        canvas.draw_rect(pictures::GOLD, Rect::new(43, 4, 41, 76), 0);
        pictures::question(canvas, Rect::new(46, 6, 34, 14));
        pictures::card(canvas, Rect::new(46, 24, 34, 48), parameters.face, self.query);
    }

    fn ground_truth(&self, _: &Parameters, out: &mut [f64]) {
        for (out, count) in out.iter_mut().zip(self.counts) {
            *out = count.into();
        }
    }

    fn markov_state(&self, parameters: &Parameters, out: &mut [f32]) {
        let kinds = parameters.face.count();
        let most = (parameters.decks * DECK / kinds) as f64;
        let (dealt, rest) = out.split_at_mut(kinds);
        let (queried, shown) = rest.split_at_mut(kinds);
        self.cards.write_dealt(dealt, |face| face, |count| count / most);
        self.queries.write_dealt(queried, |face| face, |count| count / most);
        shown.copy_from_slice(&[self.card, self.query].map(f32::from));
    }

    fn is_valid(&self, parameters: &Parameters) -> bool {
        let Parameters { decks, face, .. } = *parameters;
        self.cards.is_valid(decks, face, Some(self.card))
            && self.queries.is_valid(decks, face, Some(self.query))
            && self.cards.left() == self.queries.left()
            && self.are_counted()
    }

    fn expert(_: &Parameters) -> Option<Box<dyn Expert>> {
        Some(Box::new(Counts::default()))
    }
}

/// Counts the cards.
#[derive(Default)]
struct Counts([i32; KINDS]);

impl Expert for Counts {
    fn reset(&mut self) {
        *self = Counts::default();
    }

    fn act(&mut self, features: &[f32], _: &[f32], action: &mut [i32]) {
        self.0[features[0] as usize] += 1;
        action[0] = self.0[features[1] as usize];
    }
}
