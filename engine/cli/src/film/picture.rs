//! The pictures of a film.

use clap::ValueEnum;
use endless_gym_core::raster::FrameShape;

use crate::failure::Failure;
use crate::film::Film;

/// What a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum View {
    /// What the agent sees.
    Agent,
    /// The ground-truth view, which shows what is hidden from the agent.
    GroundTruth,
    /// Both, the agent's view on the left.
    Both,
}

/// Pixels between the two views.
const GAP: usize = 2;
const GAP_COLOUR: [u8; 3] = [24; 3];

impl View {
    /// Width and height of the pictures of a frame.
    pub fn size(self, FrameShape { width, height, .. }: FrameShape) -> (usize, usize) {
        (if self == View::Both { 2 * width + GAP } else { width }, height)
    }

    /// The picture of the film's current step, RGB pixels in rows. Call it once per step.
    pub fn picture(self, film: &mut Film) -> Result<Vec<[u8; 3]>, Failure> {
        let view = film.ground_truth_view()?;
        let agent = film.observation()?;
        // The view is the frame, magnified: reduce it to the frame's size.
        let (width, height) = (agent.width, agent.height);
        let magnified = view.width / width;
        let (of_agent, of_view) = (agent.pixels.as_chunks::<3>().0, view.pixels.as_chunks::<3>().0);
        let mut pixels = Vec::new();
        for row in 0..height {
            let of_agent = || of_agent[row * width..][..width].iter().copied();
            let of_view = || of_view[row * magnified * view.width..][..view.width].iter().step_by(magnified).copied();
            match self {
                View::Agent => pixels.extend(of_agent()),
                View::GroundTruth => pixels.extend(of_view()),
                View::Both => pixels.extend(of_agent().chain([GAP_COLOUR; GAP]).chain(of_view())),
            }
        }
        Ok(pixels)
    }
}

/// Magnifies a picture with rows of `width` pixels: each pixel becomes a square with side `scale`.
pub fn magnified<T: Copy>(pixels: &[T], width: usize, scale: usize) -> Vec<T> {
    let wide = |row: &[T]| row.iter().flat_map(|pixel| std::iter::repeat_n(*pixel, scale)).collect::<Vec<T>>();
    pixels.chunks_exact(width).flat_map(|row| wide(row).repeat(scale)).collect()
}
