//! The pixels of a circle: as runs, and by a number that vector instructions compare.

use crate::raster::Disc;

/// Largest radius of a disc that has a limit. Some larger ones have none.
const MAX_LIMITED_RADIUS: i32 = 24;

/// Which pixels a circle of one radius has.
#[derive(Debug)]
pub(super) struct Extent {
    pub disc: Disc,
    /// What [`distance`] is less than for the pixels of the disc alone; `None` for large discs, where there may be no such number.
    pub limit: Option<u16>,
}

impl Extent {
    pub fn new(radius: i32) -> Self {
        let disc = Disc::new(radius);
        let limit = if radius <= MAX_LIMITED_RADIUS { limit(&disc) } else { None };
        Extent { disc, limit }
    }
}

/// A measure of a pixel's distance from a circle's centre, by which pixels of small circles can be told from others. `x` and `y` are
/// -127 to 126, so that squares fit into 16 bits.
#[inline(always)]
pub(super) fn distance(x: i16, y: i16) -> u16 {
    // Circles are symmetric: the column -1 is as far from the centre as the column 0.
    let odd = |distance: i16| (2 * distance + 3).max(1 - 2 * distance) as u16;
    let square = |distance: i16| odd(distance).wrapping_mul(odd(distance));
    square(x).saturating_add(square(y))
}

/// The least [`distance`] of a pixel outside of a disc, if all pixels of the disc are nearer.
fn limit(disc: &Disc) -> Option<u16> {
    let radius = disc.radius() as i16;
    let quarter = (0..=radius).flat_map(|x| (0..=radius).map(move |y| (x, y)));
    let (inside, outside): (Vec<_>, Vec<_>) = quarter.partition(|(x, y)| disc.contains(((*x).into(), (*y).into())));
    let limit = outside.iter().map(|(x, y)| distance(*x, *y)).min()?;
    inside.iter().all(|(x, y)| distance(*x, *y) < limit).then_some(limit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn discs_with_a_limit_have_the_pixels_below_it() {
        for radius in 1..=MAX_LIMITED_RADIUS {
            let Extent { disc, limit } = Extent::new(radius);
            let limit = limit.unwrap();
            for (x, y) in (-127..=126).flat_map(|x| (-127..=126).map(move |y| (x, y))) {
                assert_eq!(distance(x, y) < limit, disc.contains((x.into(), y.into())), "radius {radius}: {x}, {y}");
            }
        }
        assert_eq!(Extent::new(MAX_LIMITED_RADIUS + 1).limit, None);
    }
}
