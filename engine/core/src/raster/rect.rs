//! Rectangles and their corners.

/// A rectangle in pixels: its top left corner and its size.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rect {
    /// The leftmost column.
    pub x: i32,
    /// The topmost row.
    pub y: i32,
    /// Number of columns.
    pub width: i32,
    /// Number of rows.
    pub height: i32,
}

impl Rect {
    /// A rectangle with its top left corner at `(x, y)`.
    pub const fn new(x: i32, y: i32, width: i32, height: i32) -> Self {
        Self { x, y, width, height }
    }

    /// The column to the right of the rectangle, and the row below it.
    #[inline]
    fn end(&self) -> (i32, i32) {
        (self.x.saturating_add(self.width), self.y.saturating_add(self.height))
    }

    /// Whether the rectangles have a pixel in common.
    #[inline]
    pub fn overlaps(&self, other: &Rect) -> bool {
        self.x < other.x.saturating_add(other.width)
            && other.x < self.x.saturating_add(self.width)
            && self.y < other.y.saturating_add(other.height)
            && other.y < self.y.saturating_add(self.height)
            && [self.width, self.height, other.width, other.height].iter().all(|length| *length > 0)
    }

    /// The pixels that lie in both; its width or height is 0 or less if there are none.
    #[inline]
    pub fn intersection(&self, other: &Rect) -> Rect {
        let (x, y) = (self.x.max(other.x), self.y.max(other.y));
        let (own, others) = (self.end(), other.end());
        let (right, bottom) = (own.0.min(others.0), own.1.min(others.1));
        Rect { x, y, width: right.saturating_sub(x), height: bottom.saturating_sub(y) }
    }

    /// The bounding rectangle of both.
    #[inline]
    pub fn union(&self, other: &Rect) -> Rect {
        let (x, y) = (self.x.min(other.x), self.y.min(other.y));
        let (own, others) = (self.end(), other.end());
        let (right, bottom) = (own.0.max(others.0), own.1.max(others.1));
        Rect { x, y, width: right.saturating_sub(x), height: bottom.saturating_sub(y) }
    }
}

/// The radii of a rectangle's corners in pixels; 0 is a square corner.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CornerRadii {
    /// pygame's `border_top_left_radius`.
    pub top_left: u32,
    /// pygame's `border_top_right_radius`.
    pub top_right: u32,
    /// pygame's `border_bottom_left_radius`.
    pub bottom_left: u32,
    /// pygame's `border_bottom_right_radius`.
    pub bottom_right: u32,
}
