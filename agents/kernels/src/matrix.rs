//! Matrix products.
//!
//! A product is computed in tiles of 6 x 16 numbers, which fill the vector registers (Goto and van de Geijn, "Anatomy of
//! high-performance matrix multiplication", 2008). Each number is a sum over the inner dimension from the first term to the last,
//! with fused multiply-add. It depends neither on the other rows and columns nor on the tiles, so a row of a batch gets the same
//! bits in every batch.

use std::ops::Range;

use crate::vectors::vectorised;

/// Rows of a tile.
const ROWS: usize = 6;
/// Columns of a tile: two vectors of 256 bits.
const COLUMNS: usize = 16;
/// Inner dimension of a tile. A panel of the right matrix with so many rows stays in the first cache.
const DEPTH: usize = 256;
/// Tiles above each other that share a panel while it is in the first cache.
const STACK: usize = 8;

/// A view of a matrix in memory.
#[derive(Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// A matrix with so many columns, row by row.
    ///
    /// # Panics
    ///
    /// The numbers do not fill the rows.
    pub fn new(data: &'a [f32], columns: usize) -> Self {
        assert_eq!(data.len() % columns, 0, "{} numbers do not fill rows of {columns}", data.len());
        Matrix { data, rows: data.len() / columns, columns, row_stride: columns, column_stride: 1 }
    }

    /// Some columns of the matrix.
    pub fn columns(self, columns: Range<usize>) -> Self {
        let data = self.data.get(columns.start * self.column_stride..).unwrap_or_default();
        Matrix { data, columns: columns.len(), ..self }
    }

    /// The transposed matrix.
    pub fn t(self) -> Self {
        Matrix {
            data: self.data,
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
        }
    }

    /// The numbers, row by row; with some columns only or transposed, those of the whole matrix.
    pub(crate) fn data(&self) -> &'a [f32] {
        self.data
    }
}

/// The right matrix of products, in panels of 16 columns. It keeps its memory when it is packed again.
#[derive(Default)]
pub struct Packed {
    /// For each 256 rows of the matrix: its panels, each as 256 rows of 16 numbers. Missing columns are zero.
    panels: Vec<[f32; COLUMNS]>,
    rows: usize,
    columns: usize,
}

impl Packed {
    /// Rows of the matrix.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Packs a matrix.
    pub fn pack(&mut self, matrix: Matrix) {
        (self.rows, self.columns) = (matrix.rows, matrix.columns);
        self.panels.clear();
        self.panels.resize(matrix.rows * matrix.columns.div_ceil(COLUMNS), [0.0; COLUMNS]);
        let mut start = 0;
        for depth in blocks(matrix.rows, DEPTH) {
            for columns in blocks(matrix.columns, COLUMNS) {
                let panel = &mut self.panels[start..][..depth.len()];
                start += depth.len();
                for (to, row) in panel.iter_mut().zip(depth.clone()) {
                    let to = &mut to[..columns.len()];
                    if matrix.column_stride == 1 {
                        to.copy_from_slice(&matrix.data[row * matrix.row_stride..][columns.clone()]);
                    } else {
                        for (to, column) in to.iter_mut().zip(columns.clone()) {
                            *to = matrix.data[row * matrix.row_stride + column * matrix.column_stride];
                        }
                    }
                }
            }
        }
    }
}

/// The ranges of `0..length` in steps of `size`.
fn blocks(length: usize, size: usize) -> impl Iterator<Item = Range<usize>> {
    (0..length).step_by(size).map(move |start| start..length.min(start + size))
}

/// Adds the product of `left` (M, K) and `right` (K, N) to `sum` (M, N).
///
/// # Panics
///
/// The shapes do not fit.
pub fn add_product(sum: &mut [f32], left: Matrix, right: &Packed) {
    assert_eq!(left.columns, right.rows);
    assert_eq!(sum.len(), left.rows * right.columns);
    add_tiles(sum, left, right);
}

vectorised! {
fn add_tiles(sum: &mut [f32], left: Matrix, right: &Packed) {
    let width = right.columns;
    let mut stack = [[[0.0; ROWS]; DEPTH]; STACK];
    for depth in blocks(right.rows, DEPTH) {
        let panels = &right.panels[depth.start * width.div_ceil(COLUMNS)..];
        for rows in blocks(left.rows, ROWS * STACK) {
            let tiles = rows.len().div_ceil(ROWS);
            // Tiles of about the same height: 4 and 4 rows rather than 6 and 2.
            let tile_rows =
                |tile: usize| rows.start + tile * rows.len() / tiles..rows.start + (tile + 1) * rows.len() / tiles;
            pack_tiles(left, depth.clone(), &mut stack[..tiles], tile_rows);
            for (columns, panel) in blocks(width, COLUMNS).zip(panels.chunks_exact(depth.len())) {
                for (tile, packed) in stack[..tiles].iter().enumerate() {
                    let rows = tile_rows(tile);
                    let sum = &mut sum[rows.start * width + columns.start..];
                    match rows.len() {
                        6 => add_tile::<6>(sum, width, columns.len(), packed, panel),
                        5 => add_tile::<5>(sum, width, columns.len(), packed, panel),
                        4 => add_tile::<4>(sum, width, columns.len(), packed, panel),
                        3 => add_tile::<3>(sum, width, columns.len(), packed, panel),
                        2 => add_tile::<2>(sum, width, columns.len(), packed, panel),
                        _ => add_tile::<1>(sum, width, columns.len(), packed, panel),
                    }
                }
            }
        }
    }
}
}

/// Copies rows of some columns to tiles, column by column, in the order in which they are in memory.
#[inline(always)]
fn pack_tiles(
    left: Matrix,
    columns: Range<usize>,
    tiles: &mut [[[f32; ROWS]; DEPTH]],
    rows: impl Fn(usize) -> Range<usize>,
) {
    if left.row_stride == 1 {
        for (k, column) in columns.enumerate() {
            for (tile, packed) in tiles.iter_mut().enumerate() {
                let rows = rows(tile);
                let from = &left.data[column * left.column_stride..][rows.clone()];
                copy::<ROWS>(from, &mut packed[k][..rows.len()]);
            }
        }
    } else {
        for (tile, packed) in tiles.iter_mut().enumerate() {
            for (i, row) in rows(tile).enumerate() {
                for (packed, column) in packed.iter_mut().zip(columns.clone()) {
                    packed[i] = left.data[row * left.row_stride + column * left.column_stride];
                }
            }
        }
    }
}

/// Adds the product of the first `R` columns of `left`, transposed, and `right` to a tile that begins at `sum[0]`.
#[inline(always)]
fn add_tile<const R: usize>(
    sum: &mut [f32],
    stride: usize,
    columns: usize,
    left: &[[f32; ROWS]],
    right: &[[f32; COLUMNS]],
) {
    let mut tile = [[0.0; COLUMNS]; R];
    for (tile, sum) in tile.iter_mut().zip(sum.chunks(stride)) {
        copy::<COLUMNS>(&sum[..columns], &mut tile[..columns]);
    }
    for (left, right) in left.iter().zip(right) {
        for (tile, left) in tile.iter_mut().zip(left) {
            *tile = multiply_add(*left, right, tile);
        }
    }
    for (tile, sum) in tile.iter().zip(sum.chunks_mut(stride)) {
        copy::<COLUMNS>(&tile[..columns], &mut sum[..columns]);
    }
}

/// Copies up to `N` numbers, most often `N`, for which it needs no loop.
#[inline(always)]
fn copy<const N: usize>(from: &[f32], to: &mut [f32]) {
    match (from.first_chunk::<N>(), to.first_chunk_mut::<N>()) {
        (Some(from), Some(to)) => *to = *from,
        _ => to.copy_from_slice(from),
    }
}

/// Computed as a value, which the compiler turns into vector instructions more reliably than a sum in place.
#[inline(always)]
fn multiply_add(left: f32, right: &[f32; COLUMNS], sum: &[f32; COLUMNS]) -> [f32; COLUMNS] {
    let mut next = [0.0; COLUMNS];
    for i in 0..COLUMNS {
        next[i] = left.mul_add(right[i], sum[i]);
    }
    next
}

/// Copies a vector (N,) to each row of a matrix (M, N).
pub(crate) fn fill_rows(matrix: &mut [f32], row: &[f32]) {
    matrix.chunks_exact_mut(row.len()).for_each(|to| to.copy_from_slice(row));
}

/// Adds the rows of a matrix (M, N) to `sum` (N,), from the first to the last.
pub(crate) fn add_rows(sum: &mut [f32], matrix: &[f32]) {
    for row in matrix.chunks_exact(sum.len()) {
        sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
    }
}
