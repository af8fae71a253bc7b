//! Scaling of a picture.

use super::surface::Surface;

impl Surface {
    /// The surface scaled to `width` by `height` pixels, each of which takes the nearest pixel
    /// before it, as `pygame.transform.scale` does. The colour key and the alpha carry over. A
    /// surface without pixels gives a black one.
    pub fn scale_nearest(&self, width: usize, height: usize) -> Surface {
        if self.width() == 0 || self.height() == 0 {
            return self.transformed(width, height);
        }
        let nearest = |position: usize, from: usize, to: usize| (position as u128 * from as u128 / to as u128) as usize;
        self.resampled(width, height, |x, y| (nearest(x, self.width(), width), nearest(y, self.height(), height)))
    }

    /// A surface of another size, each of whose pixels is the one that `position` gives for it.
    pub(super) fn resampled(
        &self,
        width: usize,
        height: usize,
        position: impl Fn(usize, usize) -> (usize, usize),
    ) -> Surface {
        let mut target = self.transformed(width, height);
        let source = self.pixels().as_chunks::<3>().0;
        for (index, pixel) in target.pixels_mut().as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let (x, y) = position(index / height, index % height);
            *pixel = source[x * self.height() + y];
        }
        target
    }
}
