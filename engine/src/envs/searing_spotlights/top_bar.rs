//! The bar at the top of the screen: health, the last action, whether the last reward was positive.

use std::ops::Range;

use smallvec::SmallVec;

use super::parameters::Variant;
use super::rules::{BAR_HEIGHT, SearingSpotlights};
use crate::envs::SCREEN;
use crate::raster::{Canvas, Rect, Rgb, copy_run};

const BLACK: Rgb = [0, 0, 0];
const GREY: Rgb = [50, 50, 50];
const HEALTH: Rgb = [0, 255, 0];
const DAMAGE: Rgb = [255, 0, 0];
const POSITIVE_REWARD: Rgb = [255, 255, 0];
const ACTIONS: [Rgb; 3] = [[120, 120, 120], [116, 1, 113], [255, 94, 14]];

/// The health takes the left half, and each branch of the action one of the other quarters.
const QUARTER: usize = SCREEN / 4;
pub(super) const HALF: usize = 2 * QUARTER;

/// Columns of the action's branches.
const ACTION_FIELDS: [Range<usize>; 2] = [HALF..HALF + QUARTER, HALF + QUARTER..SCREEN];

/// Columns of the reward's field between the fields of the action, and of the field without them.
const REWARD_BETWEEN: Range<usize> = QUARTER * 11 / 4..QUARTER * 11 / 4 + QUARTER / 2;
const REWARD_ALONE: Range<usize> = HALF..SCREEN;

/// What the bar shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Bar {
    /// Columns that have turned red; beyond [`HALF`] for health below zero.
    damage: u8,
    /// The red beyond the half covers the fields of the action.
    overflows: bool,
    /// By the branches of the action; `None` where it is not shown.
    action: Option<[u8; 2]>,
    /// Whether the reward was positive; `None` where that is not shown.
    reward: Option<bool>,
}

impl SearingSpotlights {
    pub(super) fn bar(&self) -> Bar {
        let (state, parameters) = (&self.state, &self.assets.parameters);
        let shows_reward = parameters.show_last_positive_reward && !state.first_frame;
        Bar {
            damage: state.red_columns,
            overflows: state.hit && usize::from(state.red_columns) > HALF,
            action: parameters.show_last_action.then(|| state.shown_action.map(|branch| branch as u8)),
            reward: shows_reward.then_some(state.shown_reward_positive),
        }
    }
}

impl Bar {
    /// Paints the bar, which covers the screen's first [`BAR_HEIGHT`] rows.
    pub fn paint(&self, variant: Variant, canvas: &mut Canvas<'_>) {
        if canvas.rows().start >= BAR_HEIGHT {
            return;
        }
        let clip = canvas.columns();
        let rows = canvas.rows().start..canvas.rows().end.min(BAR_HEIGHT);
        let mut paint = |field: Range<usize>, color: Rgb| {
            let block: [Rgb; BAR_HEIGHT] = [color; BAR_HEIGHT];
            for x in field.start.max(clip.start)..field.end.min(clip.end) {
                copy_run(block[..rows.len()].as_flattened(), canvas.run_mut(x, rows.clone()));
            }
        };
        // In the order in which the original paints, each field over what earlier steps left behind.
        let damage = usize::from(self.damage);
        paint(HALF.min(damage)..HALF, HEALTH);
        match self.action {
            Some(action) => {
                paint(0..HALF.min(damage), DAMAGE);
                for (branch, field) in action.into_iter().zip(ACTION_FIELDS) {
                    paint(field, ACTIONS[usize::from(branch)]);
                }
            }
            None => {
                paint(HALF..SCREEN, if variant.endless { BLACK } else { GREY });
                paint(0..damage, DAMAGE);
            }
        }
        if self.overflows {
            paint(HALF..damage, DAMAGE);
        }
        if let Some(positive) = self.reward {
            paint(self.reward_field(), if positive { POSITIVE_REWARD } else { GREY });
        }
    }

    /// The fields that differ from those of a bar that shows `shown`.
    pub fn changes_since(&self, shown: &Bar) -> SmallVec<[Rect; 4]> {
        let field = |columns: Range<usize>| Rect::new(columns.start as i32, 0, columns.len() as i32, BAR_HEIGHT as i32);
        let mut changes = SmallVec::new();
        match (self, shown) {
            _ if self == shown => {}
            (
                Bar { action: Some(action), damage, overflows: false, .. },
                Bar { action: Some(shown_action), damage: shown_damage, overflows: false, .. },
            ) => {
                if damage != shown_damage {
                    changes.push(field(usize::from(*damage.min(shown_damage))..usize::from(*damage.max(shown_damage))));
                }
                let fields = action.iter().zip(shown_action).zip(ACTION_FIELDS);
                changes.extend(fields.filter(|((now, before), _)| now != before).map(|(_, columns)| field(columns)));
                if self.reward != shown.reward {
                    changes.push(field(self.reward_field()));
                }
            }
            _ => changes.push(field(0..SCREEN)),
        }
        changes
    }

    fn reward_field(&self) -> Range<usize> {
        if self.action.is_some() { REWARD_BETWEEN } else { REWARD_ALONE }
    }
}
