//! Draws the bar at the top of the screen: health, the last action, and whether the last reward was positive.

use std::ops::Range;

use super::config::{BAR_HEIGHT, HEALTH_WIDTH};
use super::parameters::Variant;
use super::scene::Bar;
use crate::screen::SCREEN;
use endless_gym_core::raster::{Canvas, Rect, Rgb};

/// A column of the bar, in one colour.
type Column = [Rgb; BAR_HEIGHT];

// Stored, not computed from a colour, so that a column is two loads and two stores instead of one store per byte.
static BLACK: Column = [[0, 0, 0]; BAR_HEIGHT];
static GREY: Column = [[50, 50, 50]; BAR_HEIGHT];
static HEALTH: Column = [[0, 255, 0]; BAR_HEIGHT];
static DAMAGE: Column = [[255, 0, 0]; BAR_HEIGHT];
static POSITIVE_REWARD: Column = [[255, 255, 0]; BAR_HEIGHT];
static ACTIONS: [Column; 3] = [[[120, 120, 120]; BAR_HEIGHT], [[116, 1, 113]; BAR_HEIGHT], [[255, 94, 14]; BAR_HEIGHT]];

/// Health takes the left half, and each branch of the action one of the other two quarters.
const QUARTER: usize = SCREEN / 4;
const HALF: usize = HEALTH_WIDTH;

/// Columns of the action's branches.
const ACTION_FIELDS: [Range<usize>; 2] = [HALF..HALF + QUARTER, HALF + QUARTER..SCREEN];

/// Columns of the reward's field: between the fields of the action, and without them.
const REWARD_BETWEEN: Range<usize> = QUARTER * 11 / 4..QUARTER * 11 / 4 + QUARTER / 2;
const REWARD_ALONE: Range<usize> = HALF..SCREEN;

impl Bar {
    /// Paints the bar, which covers the screen's first [`BAR_HEIGHT`] rows.
    pub fn paint(&self, variant: Variant, canvas: &mut Canvas<'_>) {
        // In the original's drawing order.
        let damage = usize::from(self.damage);
        fill(canvas, HALF.min(damage)..HALF, &HEALTH);
        match self.action {
            Some(action) => {
                fill(canvas, 0..HALF.min(damage), &DAMAGE);
                for (branch, field) in action.into_iter().zip(ACTION_FIELDS) {
                    fill(canvas, field, &ACTIONS[usize::from(branch)]);
                }
            }
            None => {
                fill(canvas, HALF..SCREEN, if variant.endless { &BLACK } else { &GREY });
                fill(canvas, 0..damage, &DAMAGE);
            }
        }
        if self.overflows {
            fill(canvas, HALF..damage, &DAMAGE);
        }
        self.paint_reward(canvas);
    }

    /// Changes a painted bar from `shown` to this one.
    #[inline]
    pub fn repaint(&self, shown: &Bar, variant: Variant, canvas: &mut Canvas<'_>) {
        let (Some(action), Some(shown_action), true) = (self.action, shown.action, self.differs_by_fields(shown))
        else {
            return self.paint(variant, canvas);
        };
        let (damage, shown_damage) = (usize::from(self.damage), usize::from(shown.damage));
        fill(canvas, damage..shown_damage.min(HALF), &HEALTH);
        fill(canvas, shown_damage..damage.min(HALF), &DAMAGE);
        // The reward's field covers a part of both fields.
        let covered = if self.reward.is_some() { REWARD_BETWEEN } else { HALF + QUARTER..HALF + QUARTER };
        let fields = [HALF..covered.start, covered.end..SCREEN];
        for ((now, before), field) in action.into_iter().zip(shown_action).zip(fields) {
            if now != before {
                fill(canvas, field, &ACTIONS[usize::from(now)]);
            }
        }
        if self.reward != shown.reward {
            self.paint_reward(canvas);
        }
    }

    fn paint_reward(&self, canvas: &mut Canvas<'_>) {
        if let Some(positive) = self.reward {
            fill(canvas, self.reward_field(), if positive { &POSITIVE_REWARD } else { &GREY });
        }
    }

    /// Whether the bar can be changed from `shown` to this one field by field.
    fn differs_by_fields(&self, shown: &Bar) -> bool {
        self.reward.is_some() == shown.reward.is_some() && !self.overflows && !shown.overflows
    }

    /// The rectangles in which this bar differs from `shown`.
    pub fn changes_since(&self, shown: &Bar) -> impl Iterator<Item = Rect> {
        let mut changes = [0..SCREEN, 0..0, 0..0, 0..0];
        if let (Some(action), Some(shown_action), true) = (self.action, shown.action, self.differs_by_fields(shown)) {
            let (damage, shown_damage) = (usize::from(self.damage), usize::from(shown.damage));
            let [left, right] = ACTION_FIELDS;
            changes = [
                damage.min(shown_damage)..damage.max(shown_damage),
                if action[0] == shown_action[0] { 0..0 } else { left },
                if action[1] == shown_action[1] { 0..0 } else { right },
                if self.reward == shown.reward { 0..0 } else { self.reward_field() },
            ];
        }
        let field = |columns: Range<usize>| Rect::new(columns.start as i32, 0, columns.len() as i32, BAR_HEIGHT as i32);
        changes.into_iter().map(field)
    }

    fn reward_field(&self) -> Range<usize> {
        if self.action.is_some() { REWARD_BETWEEN } else { REWARD_ALONE }
    }
}

/// Paints columns of the bar within the canvas' clip.
#[inline]
fn fill(canvas: &mut Canvas<'_>, columns: Range<usize>, color: &Column) {
    let (clip, rows) = (canvas.columns(), canvas.rows());
    let rows = rows.start..rows.end.min(BAR_HEIGHT);
    let columns = columns.start.max(clip.start)..columns.end.min(clip.end);
    if columns.start >= columns.end {
        return;
    }
    canvas.mark_dirty(columns.clone(), &rows);
    let columns = &mut canvas.pixels_mut().as_chunks_mut::<3>().0.as_chunks_mut::<SCREEN>().0[columns];
    if rows.len() == BAR_HEIGHT {
        columns.iter_mut().for_each(|column| column[..BAR_HEIGHT].copy_from_slice(color));
    } else if !rows.is_empty() {
        columns.iter_mut().for_each(|column| column[rows.clone()].copy_from_slice(&color[rows.clone()]));
    }
}
