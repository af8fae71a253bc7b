//! The bar at the top of the screen: health, the last action, whether the last reward was positive.

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
const REWARD_BETWEEN: std::ops::Range<usize> = QUARTER * 11 / 4..QUARTER * 11 / 4 + QUARTER / 2;
const REWARD_ALONE: std::ops::Range<usize> = HALF..SCREEN;

impl SearingSpotlights {
    /// Columns of the health bar that have turned red; beyond [`HALF`] for health below zero.
    pub(super) fn damage_width(&self) -> usize {
        let lost = 1.0 - self.state.health_share(&self.assets.parameters);
        ((HALF as f64 * lost) as usize).min(SCREEN)
    }

    pub(super) fn draw_bar(&self, canvas: &mut Canvas<'_>) {
        let (state, parameters) = (&self.state, &self.assets.parameters);
        // The columns in the order in which the original paints them, each over what earlier steps left behind.
        let mut bar = [if self.assets.variant.endless { BLACK } else { GREY }; SCREEN];
        let damage = self.damage_width();
        bar[..HALF].fill(HEALTH);
        bar[..damage].fill(DAMAGE);
        if parameters.show_last_action {
            for (branch, field) in state.shown_action.iter().zip(bar[HALF..].chunks_exact_mut(QUARTER)) {
                field.fill(ACTIONS[*branch as usize]);
            }
        }
        if state.hit {
            bar[..damage].fill(DAMAGE);
        }
        if parameters.show_last_positive_reward && !state.first_frame {
            let field = if parameters.show_last_action { REWARD_BETWEEN } else { REWARD_ALONE };
            bar[field].fill(if state.shown_reward_positive { POSITIVE_REWARD } else { GREY });
        }
        for (column, color) in canvas.pixels_mut().chunks_exact_mut(SCREEN * 3).zip(bar) {
            column[..BAR_HEIGHT * 3].as_chunks_mut().0.fill(color);
        }
    }
}
