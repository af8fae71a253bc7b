//! Pictures for people who watch and play. They show what the agent observes, and nothing of the hidden state.

use endless_gym_core::raster::{Canvas, CornerRadii, FrameShape, Rect, Rgb};

use crate::deck::Face;

/// Size of all pictures.
pub const PICTURE: FrameShape = FrameShape::rgb(84, 84);
/// The place of a card that is alone.
pub const ALONE: Rect = Rect::new(20, 10, 44, 64);

/// Baize, the background of card games.
const TABLE: Rgb = [20, 70, 58];
pub const PAPER: Rgb = [246, 243, 234];
pub const INK: Rgb = [28, 30, 38];
pub const RED: Rgb = [204, 44, 56];
pub const GOLD: Rgb = [240, 186, 60];
pub const BLUE: Rgb = [52, 92, 170];
pub const DARK: Rgb = [24, 28, 40];
pub const GREY: Rgb = [120, 126, 140];
pub const GREEN: Rgb = [70, 176, 96];

/// Bits of the rows of a picture of 5 columns.
type Glyph = [u8; 7];

const DIGITS: [Glyph; 10] = [
    [0b01110, 0b10001, 0b10011, 0b10101, 0b11001, 0b10001, 0b01110],
    [0b00100, 0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
    [0b01110, 0b10001, 0b00001, 0b00010, 0b00100, 0b01000, 0b11111],
    [0b11111, 0b00010, 0b00100, 0b00010, 0b00001, 0b10001, 0b01110],
    [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010],
    [0b11111, 0b10000, 0b11110, 0b00001, 0b00001, 0b10001, 0b01110],
    [0b00110, 0b01000, 0b10000, 0b11110, 0b10001, 0b10001, 0b01110],
    [0b11111, 0b00001, 0b00010, 0b00100, 0b01000, 0b01000, 0b01000],
    [0b01110, 0b10001, 0b10001, 0b01110, 0b10001, 0b10001, 0b01110],
    [0b01110, 0b10001, 0b10001, 0b01111, 0b00001, 0b00010, 0b01100],
];
const ACE: Glyph = [0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001];
const TEN: Glyph = [0b10111, 0b10101, 0b10101, 0b10101, 0b10101, 0b10101, 0b10111];
const JACK: Glyph = [0b00111, 0b00010, 0b00010, 0b00010, 0b00010, 0b10010, 0b01100];
const QUEEN: Glyph = [0b01110, 0b10001, 0b10001, 0b10001, 0b10101, 0b10010, 0b01101];
const KING: Glyph = [0b10001, 0b10010, 0b10100, 0b11000, 0b10100, 0b10010, 0b10001];
const QUESTION: Glyph = [0b01110, 0b10001, 0b00001, 0b00010, 0b00100, 0b00000, 0b00100];
/// Bits of the rows of pictures of 7 columns: spades, diamonds, clubs, hearts.
const SUITS: [Glyph; 4] = [
    [0b0001000, 0b0011100, 0b0111110, 0b1111111, 0b1101011, 0b0001000, 0b0011100],
    [0b0001000, 0b0011100, 0b0111110, 0b1111111, 0b0111110, 0b0011100, 0b0001000],
    [0b0011100, 0b0011100, 0b1101011, 0b1111111, 0b1101011, 0b0001000, 0b0011100],
    [0b0110110, 0b1111111, 0b1111111, 0b1111111, 0b0111110, 0b0011100, 0b0001000],
];

/// Draws a glyph in the middle of a rectangle, as large as fits.
fn draw(canvas: &mut Canvas<'_>, within: Rect, glyph: &Glyph, columns: i32, color: Rgb) {
    let scale = (within.width / columns).min(within.height / 7).max(1);
    let (x, y) = (within.x + (within.width - columns * scale) / 2, within.y + (within.height - 7 * scale) / 2);
    for (row, bits) in (0..).zip(glyph) {
        for column in (0..columns).filter(|column| bits >> (columns - 1 - column) & 1 == 1) {
            canvas.draw_rect(color, Rect::new(x + column * scale, y + row * scale, scale, scale), 0);
        }
    }
}

/// Draws a digit from 0 to 9.
pub fn digit(canvas: &mut Canvas<'_>, within: Rect, digit: u8, color: Rgb) {
    draw(canvas, within, &DIGITS[usize::from(digit.min(9))], 5, color);
}

/// The part of a rectangle that is so far from its border.
fn inner(Rect { x, y, width, height }: Rect, border: i32) -> Rect {
    Rect::new(x + border, y + border, width - 2 * border, height - 2 * border)
}

fn blank(canvas: &mut Canvas<'_>, place: Rect, color: Rgb) {
    let radius = place.width as u32 / 9;
    let radii = CornerRadii { top_left: radius, top_right: radius, bottom_left: radius, bottom_right: radius };
    canvas.draw_rounded_rect(color, place, 0, radii);
}

/// Covers the canvas with the table for cards.
pub fn table(canvas: &mut Canvas<'_>) {
    canvas.fill(TABLE);
}

/// Draws a card.
pub fn card(canvas: &mut Canvas<'_>, place: Rect, face: Face, value: u8) {
    blank(canvas, place, PAPER);
    let within = inner(place, if place.width > 20 { 4 } else { 1 });
    let suit = usize::from(value % 4);
    match face {
        Face::Colour => canvas.draw_rect(if value == 0 { INK } else { RED }, within, 0),
        Face::Suit => draw(canvas, within, &SUITS[suit], 7, if suit % 2 == 1 { RED } else { INK }),
        Face::Rank | Face::Card => {
            let rank = if face == Face::Card { value / 4 } else { value };
            let glyph = match rank {
                0 => &ACE,
                9 => &TEN,
                10 => &JACK,
                11 => &QUEEN,
                12 => &KING,
                _ => &DIGITS[usize::from(rank + 1)],
            };
            draw(canvas, within, glyph, 5, INK);
        }
    }
}

/// Draws a question mark.
pub fn question(canvas: &mut Canvas<'_>, within: Rect) {
    draw(canvas, within, &QUESTION, 5, INK);
}

/// Draws the back of a card, with a question mark if the card is asked for.
pub fn back(canvas: &mut Canvas<'_>, place: Rect, is_asked: bool) {
    blank(canvas, place, if is_asked { GOLD } else { BLUE });
    if is_asked {
        question(canvas, inner(place, 4));
    }
}

/// Draws a bar from the middle of a row to the right or to the left, by a share from -1 to 1.
pub fn gauge(canvas: &mut Canvas<'_>, y: i32, share: f64, color: Rgb) {
    canvas.draw_rect(GREY, Rect::new(4, y, 76, 10), 1);
    let length = (share.clamp(-1.0, 1.0) * 36.0).round() as i32;
    canvas.draw_rect(color, Rect::new(42 + length.min(0), y + 2, length.abs(), 6), 0);
    canvas.draw_rect(PAPER, Rect::new(41, y - 2, 2, 14), 0);
}

#[cfg(test)]
mod tests {
    use std::collections::{HashMap, HashSet};

    use endless_gym_core::batch::{Batch, zeroed};
    use endless_gym_core::envs::ObservationSpace;
    use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
    use endless_gym_core::random::Generator;

    use crate::popgym;

    /// Equal observations have equal pictures, so a picture shows nothing of the hidden state; where observations are integers, different
    /// ones have different pictures.
    #[test]
    fn pictures_show_observations_and_nothing_else() {
        for spec in popgym().specs() {
            let config = PoolConfig::new(spec.id, 1);
            let mut pool = Pool::new(popgym(), &config, &Threads::new(1).unwrap()).unwrap();
            let (mut blocks, mut random) = (zeroed(pool.layout().blocks()), Generator::from_seed(5));
            pool.reset(ResetRequest::Seed(5), &mut blocks).unwrap();
            let mut pictures = HashMap::new();
            for step in 0..400 {
                let features = Batch::new(pool.layout(), &blocks).features().to_vec();
                let picture = pool.frame(0).unwrap();
                let key: Vec<u32> = features.iter().map(|number| number.to_bits()).collect();
                let known = pictures.entry(key).or_insert_with(|| picture.clone());
                assert!(*known == picture, "{}: {features:?} has two pictures after {step} steps", spec.id);
                pool.step(&spec.action_space.sample(&mut random), &mut blocks).unwrap();
            }
            let different: HashSet<_> = pictures.values().collect();
            let is_box = matches!(spec.observation_space, Some(ObservationSpace::Box { .. }));
            assert!(different.len() > 1 && (is_box || different.len() == pictures.len()), "{}", spec.id);
        }
    }
}
