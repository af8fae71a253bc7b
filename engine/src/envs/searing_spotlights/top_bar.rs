//! The bar at the top of the screen: health, the last action, whether the last reward was positive.

use std::ops::Range;

use super::drawing::COLUMN;
use super::rules::{BAR_HEIGHT, SearingSpotlights};
use crate::envs::SCREEN;
use crate::raster::{Canvas, Rgb};

const BLACK: Rgb = [0, 0, 0];
const GREY: Rgb = [50, 50, 50];
const HEALTH: Rgb = [0, 255, 0];
const DAMAGE: Rgb = [255, 0, 0];
const POSITIVE_REWARD: Rgb = [255, 255, 0];
const ACTIONS: [Rgb; 3] = [[120, 120, 120], [116, 1, 113], [255, 94, 14]];

/// The health takes the left half, and each branch of the action one of the other quarters.
const QUARTER: usize = SCREEN / 4;
pub(super) const HALF: usize = 2 * QUARTER;

/// Columns of the reward's field between the fields of the action, and of the field without them.
const REWARD_BETWEEN: Range<usize> = QUARTER * 11 / 4..QUARTER * 11 / 4 + QUARTER / 2;
const REWARD_ALONE: Range<usize> = HALF..SCREEN;

impl SearingSpotlights {
    /// Columns of the health bar that have turned red; beyond [`HALF`] for health below zero.
    pub(super) fn damage_width(&self) -> usize {
        let lost = 1.0 - self.state.health_share(&self.assets.parameters);
        ((HALF as f64 * lost) as usize).min(SCREEN)
    }

    pub(super) fn draw_bar(&self, canvas: &mut Canvas<'_>) {
        let (state, parameters) = (&self.state, &self.assets.parameters);
        let columns = canvas.pixels_mut().as_chunks_mut::<COLUMN>().0;
        let mut paint = |field: Range<usize>, color: Rgb| {
            // A column's part of the bar is a block of its own, which is a store or two.
            let block: [Rgb; BAR_HEIGHT] = [color; BAR_HEIGHT];
            columns[field].iter_mut().for_each(|column| column[..BAR_HEIGHT * 3].copy_from_slice(block.as_flattened()));
        };
        // In the order in which the original paints, each field over what earlier steps left behind.
        let damage = self.damage_width();
        paint(HALF.min(damage)..HALF, HEALTH);
        if parameters.show_last_action {
            paint(0..HALF.min(damage), DAMAGE);
            for (branch, start) in state.shown_action.iter().zip([HALF, HALF + QUARTER]) {
                paint(start..start + QUARTER, ACTIONS[*branch as usize]);
            }
        } else {
            paint(HALF..SCREEN, if self.assets.variant.endless { BLACK } else { GREY });
            paint(0..damage, DAMAGE);
        }
        if state.hit && damage > HALF {
            paint(HALF..damage, DAMAGE);
        }
        if parameters.show_last_positive_reward && !state.first_frame {
            let field = if parameters.show_last_action { REWARD_BETWEEN } else { REWARD_ALONE };
            paint(field, if state.shown_reward_positive { POSITIVE_REWARD } else { GREY });
        }
    }
}
