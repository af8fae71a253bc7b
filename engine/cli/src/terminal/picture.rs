//! Pictures of half blocks: a character shows two pixels, one above the other.

use endless_gym_core::envs::view::Picture;
use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Color;
use ratatui::widgets::Widget;

/// A square of RGB pixels, in rows.
#[derive(Clone, Debug)]
pub struct Pixels {
    pub side: usize,
    pub pixels: Vec<[u8; 3]>,
}

impl Pixels {
    /// The smallest square around a picture, in whose middle it lies on black. `color` returns the colour of the pixel (x, y).
    pub fn framed(width: usize, height: usize, color: impl Fn(usize, usize) -> [u8; 3]) -> Pixels {
        let side = width.max(height);
        let (left, top) = ((side - width) / 2, (side - height) / 2);
        let pixel = |place: usize| match ((place % side).checked_sub(left), (place / side).checked_sub(top)) {
            (Some(x), Some(y)) if x < width && y < height => color(x, y),
            _ => [0; 3],
        };
        Pixels { side, pixels: (0..side * side).map(pixel).collect() }
    }

    /// The same picture with another side: magnified, or reduced by averaging pixels.
    pub fn resized(&self, side: usize) -> Pixels {
        let range = |place: usize| place * self.side / side..((place + 1) * self.side).div_ceil(side);
        let average = |place: usize| {
            let (rows, columns) = (range(place / side), range(place % side));
            let count = rows.len() * columns.len();
            std::array::from_fn(|channel| {
                let line = |row: usize| self.pixels[row * self.side..][columns.clone()].iter();
                let sum: usize = rows.clone().flat_map(line).map(|pixel| usize::from(pixel[channel])).sum();
                (sum / count) as u8
            })
        };
        Pixels { side, pixels: (0..side * side).map(average).collect() }
    }
}

impl From<&Picture> for Pixels {
    fn from(picture: &Picture) -> Pixels {
        let colors = picture.pixels.as_chunks().0;
        Pixels::framed(picture.width, picture.height, |x, y| colors[y * picture.width + x])
    }
}

impl Widget for &Pixels {
    fn render(self, area: Rect, buffer: &mut Buffer) {
        let [rows, columns] = [self.side.div_ceil(2).min(area.height.into()), self.side.min(area.width.into())];
        for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
            let colour = |row: usize| {
                let pixel = (row < self.side).then(|| self.pixels[row * self.side + column]);
                pixel.map_or(Color::Reset, |[r, g, b]| Color::Rgb(r, g, b))
            };
            let cell = &mut buffer[(area.x + column as u16, area.y + row as u16)];
            cell.set_char('▀').set_fg(colour(2 * row)).set_bg(colour(2 * row + 1));
        }
    }
}

/// The largest side of a picture of a frame with side `own` that fits into `columns` and `lines`: a multiple of `own`, or less
/// if that does not fit. It is even, so that the picture ends with a whole character; 0 if there is no room.
pub fn fitting(columns: u16, lines: u16, own: usize) -> usize {
    let room = usize::from(columns).min(2 * usize::from(lines));
    if room >= own { (room / own * own) & !1 } else { room & !1 }
}

#[cfg(test)]
mod tests {
    use endless_gym_memory_gym::SCREEN;

    use super::*;

    #[test]
    fn smaller_pictures_have_averages_and_larger_ones_squares() {
        let mut pixels = vec![[0; 3]; SCREEN * SCREEN];
        pixels[10 * SCREEN + 21] = [0, 200, 40];
        let picture = Pixels { side: SCREEN, pixels };
        let mut expected = vec![[0; 3]; SCREEN * SCREEN / 4];
        expected[5 * SCREEN / 2 + 10] = [0, 50, 10];
        assert_eq!(picture.resized(SCREEN / 2).pixels, expected);
        let mut expected = vec![[0; 3]; 4 * SCREEN * SCREEN];
        for place in [20, 21].map(|row| row * 2 * SCREEN + 42) {
            expected[place..place + 2].fill([0, 200, 40]);
        }
        assert_eq!(picture.resized(2 * SCREEN).pixels, expected);
    }

    #[test]
    fn a_picture_is_cut_where_the_terminal_ends() {
        let picture = Pixels { side: SCREEN, pixels: vec![[9; 3]; SCREEN * SCREEN] };
        let mut buffer = Buffer::empty(Rect::new(0, 0, 5, 2));
        (&picture).render(Rect::new(0, 0, 5, 2), &mut buffer);
        assert_eq!(buffer[(4, 1)].symbol(), "▀");
        assert_eq!(
            [(0, 9), (80, 21), (83, 50), (200, 50), (171, 85)].map(|(columns, lines)| fitting(columns, lines, SCREEN)),
            [0, 42, 82, 84, 168]
        );
    }
}
