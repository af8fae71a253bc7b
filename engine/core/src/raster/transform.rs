//! Scaling and rotation of a picture, as `pygame.transform` does.

use super::surface::Surface;

impl Surface {
    /// The surface scaled to `width` by `height` pixels, each of which takes the nearest pixel before it, as in
    /// `pygame.transform.scale`. The colour key and the alpha carry over. A surface without pixels gives a black one.
    pub fn scale_nearest(&self, width: usize, height: usize) -> Surface {
        if self.width() == 0 || self.height() == 0 {
            return self.transformed(width, height);
        }
        let nearest = |position: usize, from: usize, to: usize| (position as u128 * from as u128 / to as u128) as usize;
        self.resampled(width, height, |x, y| (nearest(x, self.width(), width), nearest(y, self.height(), height)))
    }

    /// A surface of another size. `position` returns the source position of each pixel.
    fn resampled(&self, width: usize, height: usize, position: impl Fn(usize, usize) -> (usize, usize)) -> Surface {
        let mut target = self.transformed(width, height);
        let source = self.pixels().as_chunks::<3>().0;
        for (index, pixel) in target.pixels_mut().as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let (x, y) = position(index / height, index % height);
            *pixel = source[x * self.height() + y];
        }
        target
    }

    /// The surface rotated counterclockwise by `degrees`, as in `pygame.transform.rotate`.
    ///
    /// Multiples of 90 degrees move the pixels exactly. Other angles give a surface that is large enough for the rotated
    /// picture, sample the nearest pixel in 16.16 fixed point, and fill the rest with the colour key or, without one, with the
    /// colour of the top left pixel. The colour key and the alpha carry over.
    pub fn rotate(&self, degrees: i32) -> Surface {
        if self.width() == 0 || self.height() == 0 {
            self.clone()
        } else if degrees % 90 == 0 {
            self.rotate_by_quarters(degrees / 90)
        } else {
            self.rotate_by_sampling(degrees)
        }
    }

    fn rotate_by_quarters(&self, quarters: i32) -> Surface {
        let quarters = quarters.rem_euclid(4);
        let (last_x, last_y) = (self.width() - 1, self.height() - 1);
        let (width, height) =
            if quarters % 2 == 0 { (self.width(), self.height()) } else { (self.height(), self.width()) };
        self.resampled(width, height, |x, y| match quarters {
            0 => (x, y),
            1 => (last_x - y, x),
            2 => (last_x - x, last_y - y),
            _ => (y, last_y - x),
        })
    }

    fn rotate_by_sampling(&self, degrees: i32) -> Surface {
        let radians = f64::from(degrees as f32) * 0.017_453_292_519_943_29;
        let (sine, cosine) = radians.sin_cos();
        let (source_width, source_height) = (self.width() as f64, self.height() as f64);
        let extent = |a: f64, b: f64| (a + b).abs().max((a - b).abs()) as i64;
        let width = extent(cosine * source_width, sine * source_height);
        let height = extent(sine * source_width, cosine * source_height);

        // Fixed point with 16 bits of fraction; the source position of the pixel (x, y) is
        // (start + step * x) per axis.
        let one = f64::from(1 << 16);
        let (step_x, step_y) = ((cosine * one) as i64, (sine * one) as i64);
        let half = |length: i64| length << 15;
        let source_size = (self.width() as i64, self.height() as i64);
        let reach = half(width - 1) as f64;
        let start_x = half(width) - (cosine * reach) as i64 + half(source_size.0 - width);
        let start_y = half(height) - (sine * reach) as i64 + half(source_size.1 - height);

        let mut target = self.transformed(width.max(0) as usize, height.max(0) as usize);
        let source = self.pixels().as_chunks::<3>().0;
        let background = self.color_key().unwrap_or(source[0]);
        let columns = target.pixels_mut().as_chunks_mut::<3>().0.chunks_exact_mut(height.max(1) as usize);
        for (x, column) in (0..).zip(columns) {
            for (y, pixel) in (0..).zip(column) {
                let up = height / 2 - y;
                let source_x = (start_x + step_y * up + step_x * x) >> 16;
                let source_y = (start_y - step_x * up + step_y * x) >> 16;
                let is_inside = (0..source_size.0).contains(&source_x) && (0..source_size.1).contains(&source_y);
                *pixel = if is_inside { source[(source_x * source_size.1 + source_y) as usize] } else { background };
            }
        }
        target
    }
}
