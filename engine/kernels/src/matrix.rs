//! Matrix products.
//!
//! A product is computed in tiles of 6 x 16 numbers, or 6 x 32 with vectors of 512 bits, which fill the vector registers (Goto and
//! van de Geijn, "Anatomy of high-performance matrix multiplication", 2008). Each number is a sum over the inner dimension from the
//! first term to the last, with fused multiply-add. It depends neither on the other rows and columns nor on the tiles, so a row of a
//! batch gets the same bits in every batch and on every CPU.

use std::array::from_fn;
use std::ops::Range;

use crate::vectors::vectorised;

/// Rows of a tile.
const ROWS: usize = 6;
/// Columns of a panel: two vectors of 256 bits, or one of 512.
const COLUMNS: usize = 16;
/// Inner dimension of a tile. Panels of the right matrix with so many rows stay in the first cache.
const DEPTH: usize = 256;
/// Rows of the tiles that share panels while these are in the first cache.
const HEIGHT: usize = 8 * ROWS;

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
    /// A matrix with so many columns, row by row. Panics if the numbers do not fill the rows.
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

/// A row of a panel, in one line of the cache.
#[derive(Clone, Copy, Default)]
#[repr(align(64))]
struct Row([f32; COLUMNS]);

/// The right matrix of products, in panels of 16 columns. It keeps its memory when it is packed again.
#[derive(Default)]
pub struct Packed {
    /// For each 256 rows of the matrix: its panels, each as 256 rows of 16 numbers. Missing columns are zero.
    panels: Vec<Row>,
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
        self.panels.resize(matrix.rows * matrix.columns.div_ceil(COLUMNS), Row::default());
        let mut start = 0;
        for depth in blocks(matrix.rows, DEPTH) {
            for columns in blocks(matrix.columns, COLUMNS) {
                let panel = &mut self.panels[start..][..depth.len()];
                start += depth.len();
                for (to, row) in panel.iter_mut().zip(depth.clone()) {
                    let to = &mut to.0[..columns.len()];
                    if matrix.column_stride == 1 {
                        copy::<COLUMNS>(&matrix.data[row * matrix.row_stride..][columns.clone()], to);
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

/// What a product is added to.
#[derive(Clone, Copy)]
enum Start<'a> {
    Zeros,
    /// The same numbers (N,) in each row.
    Row(&'a [f32]),
    /// The former result.
    Result,
}

/// Computes the product of `left` (M, K) and `right` (K, N), (M, N). Panics if the shapes do not fit, or K is 0.
pub fn product(result: &mut [f32], left: Matrix, right: &Packed) {
    assert_ne!(right.rows, 0);
    compute(result, Start::Zeros, left, right);
}

/// Computes the product of `left` (M, K) and `right` (K, N), with `row` (N,) added to each row, (M, N). Panics if the
/// shapes do not fit, or K is 0.
pub fn product_plus_row(result: &mut [f32], row: &[f32], left: Matrix, right: &Packed) {
    assert_eq!(row.len(), right.columns);
    assert_ne!(right.rows, 0);
    compute(result, Start::Row(row), left, right);
}

/// Adds the product of `left` (M, K) and `right` (K, N) to `sum` (M, N).
pub fn add_product(sum: &mut [f32], left: Matrix, right: &Packed) {
    compute(sum, Start::Result, left, right);
}

fn compute(result: &mut [f32], start: Start, left: Matrix, right: &Packed) {
    assert_eq!(left.columns, right.rows);
    assert_eq!(result.len(), left.rows * right.columns);
    compute_blocks(result, start, left, right);
}

vectorised! {
fn compute_blocks(result: &mut [f32], start: Start, left: Matrix, right: &Packed) {
    if LANES == COLUMNS {
        compute_blocks_with::<2>(result, start, left, right);
    } else {
        compute_blocks_with::<1>(result, start, left, right);
    }
}
}

/// Computes a product in tiles that are `P` panels wide, in blocks of rows and of the inner dimension.
#[inline(always)]
fn compute_blocks_with<const P: usize>(result: &mut [f32], start: Start, left: Matrix, right: &Packed) {
    let blocks =
        blocks(right.rows, DEPTH).flat_map(|depth| blocks(left.rows, HEIGHT).map(move |rows| (rows, depth.clone())));
    if left.row_stride == 1 {
        // The columns of a block may be a page apart; a copy of the block needs fewer entries of the translation lookaside buffer.
        let mut copies = [[0.0; HEIGHT]; DEPTH];
        for (rows, depth) in blocks {
            for (to, column) in copies.iter_mut().zip(depth.clone()) {
                let from = &left.data[column * left.column_stride + rows.start..];
                match from.first_chunk() {
                    // Numbers behind the rows do no harm, and copying a fixed count needs no loop.
                    Some(from) => *to = *from,
                    None => to[..rows.len()].copy_from_slice(&from[..rows.len()]),
                }
            }
            let block = Matrix { data: copies.as_flattened(), rows: rows.len(), column_stride: HEIGHT, ..left };
            compute_block::<P>(result, start, rows.start, depth, block, right);
        }
    } else {
        for (rows, depth) in blocks {
            let data = &left.data[rows.start * left.row_stride + depth.start..];
            let block = Matrix { data, rows: rows.len(), ..left };
            compute_block::<P>(result, start, rows.start, depth, block, right);
        }
    }
}

/// Computes the rows of `result` from `row` on: the product of a block of the left matrix and the rows `depth` of the right one.
///
/// It is long and called twice, so it is inlined only where `vectorised` needs that, which keeps the page for browsers small.
#[cfg_attr(target_arch = "x86_64", inline(always))]
fn compute_block<const P: usize>(
    result: &mut [f32],
    start: Start,
    row: usize,
    depth: Range<usize>,
    block: Matrix,
    right: &Packed,
) {
    let width = right.columns;
    let panels = right.panels[depth.start * width.div_ceil(COLUMNS)..].chunks(P * depth.len());
    for (columns, panels) in blocks(width, P * COLUMNS).zip(panels) {
        let result = &mut result[row * width + columns.start..];
        let start = match start {
            _ if depth.start > 0 => Start::Result,
            Start::Row(row) => Start::Row(&row[columns.clone()]),
            Start::Zeros | Start::Result => start,
        };
        // The compiler drops the other branch where panels are computed one at a time.
        if P == 1 || columns.len() > (P - 1) * COLUMNS {
            let panels = from_fn(|i| &panels[i * depth.len()..][..depth.len()]);
            compute_tiles::<P>(result, start, width, columns.len(), block, panels);
        } else {
            compute_tiles::<1>(result, start, width, columns.len(), block, [&panels[..depth.len()]]);
        }
    }
}

/// Computes tiles above each other, of about the same height: 4 and 4 rows rather than 6 and 2.
#[inline(always)]
fn compute_tiles<const P: usize>(
    result: &mut [f32],
    start: Start,
    stride: usize,
    columns: usize,
    left: Matrix,
    panels: [&[Row]; P],
) {
    let tiles = left.rows.div_ceil(ROWS);
    for tile in 0..tiles {
        let (row, end) = (tile * left.rows / tiles, (tile + 1) * left.rows / tiles);
        let (result, data) = (&mut result[row * stride..], &left.data[row * left.row_stride..]);
        let left = Matrix { data, rows: end - row, ..left };
        match left.rows {
            6 => compute_tile::<6, P>(result, start, stride, columns, left, panels),
            5 => compute_tile::<5, P>(result, start, stride, columns, left, panels),
            4 => compute_tile::<4, P>(result, start, stride, columns, left, panels),
            3 => compute_tile::<3, P>(result, start, stride, columns, left, panels),
            2 => compute_tile::<2, P>(result, start, stride, columns, left, panels),
            _ => compute_tile::<1, P>(result, start, stride, columns, left, panels),
        }
    }
}

/// Computes a tile that begins at `result[0]`: the product of the first `R` rows of `left` and the panels.
#[inline(always)]
fn compute_tile<const R: usize, const P: usize>(
    result: &mut [f32],
    start: Start,
    stride: usize,
    columns: usize,
    left: Matrix,
    panels: [&[Row]; P],
) {
    let full = columns == P * COLUMNS;
    let read = |tile: &mut [[f32; COLUMNS]; P], from: &[f32]| match from.as_chunks().0.first_chunk() {
        Some(from) if full => *tile = *from,
        _ => tile.as_flattened_mut()[..columns].copy_from_slice(&from[..columns]),
    };
    let mut tile = [[[0.0; COLUMNS]; P]; R];
    match start {
        Start::Zeros => {}
        Start::Row(row) => tile.iter_mut().for_each(|tile| read(tile, row)),
        Start::Result => tile.iter_mut().zip(result.chunks(stride)).for_each(|(tile, result)| read(tile, result)),
    }
    let depth = panels[0].len();
    if left.row_stride == 1 {
        for (k, column) in left.data.chunks(left.column_stride).take(depth).enumerate() {
            add_outer(&mut tile, from_fn(|i| column[i]), from_fn(|p| panels[p][k].0));
        }
    } else {
        let rows: [_; R] = from_fn(|i| &left.data[i * left.row_stride..][..depth]);
        for k in 0..depth {
            add_outer(&mut tile, from_fn(|i| rows[i][k]), from_fn(|p| panels[p][k].0));
        }
    }
    for (tile, result) in tile.iter().zip(result.chunks_mut(stride)) {
        match result.as_chunks_mut().0.first_chunk_mut() {
            Some(result) if full => *result = *tile,
            _ => result[..columns].copy_from_slice(&tile.as_flattened()[..columns]),
        }
    }
}

/// Adds the product of a column and a row, both as values, which the compiler keeps in registers, to a tile.
#[inline(always)]
fn add_outer<const R: usize, const P: usize>(
    tile: &mut [[[f32; COLUMNS]; P]; R],
    column: [f32; R],
    row: [[f32; COLUMNS]; P],
) {
    for (tile, left) in tile.iter_mut().zip(column) {
        for (tile, right) in tile.iter_mut().zip(row) {
            *tile = multiply_add(left, &right, tile);
        }
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

vectorised! {
/// Adds the rows of a matrix (M, N) to `sum` (N,), from the first to the last.
pub(crate) fn add_rows(sum: &mut [f32], matrix: &[f32]) {
    for row in matrix.chunks_exact(sum.len()) {
        sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_of_a_product_is_the_sum_of_its_terms_in_order() {
        let numbers = |count: usize| (0..count).map(|i| (i as f32 * 0.7).sin()).collect::<Vec<f32>>();
        let at = |matrix: Matrix, row, column| matrix.data[row * matrix.row_stride + column * matrix.column_stride];
        let mut packed = Packed::default();
        for (rows, depth, columns) in [(1, 1, 1), (50, 3, 31), (7, 260, 33), (64, 64, 48), (97, 300, 50)] {
            let (left, right, start) = (numbers(rows * depth), numbers(depth * columns), numbers(rows * columns));
            for right in [Matrix::new(&right, columns), Matrix::new(&right, depth).t()] {
                packed.pack(right);
                for left in [Matrix::new(&left, depth), Matrix::new(&left, rows).t()] {
                    let sum = |(i, start): (usize, &f32)| {
                        let (row, column) = (i / columns, i % columns);
                        (0..depth).fold(*start, |sum, k| at(left, row, k).mul_add(at(right, k, column), sum))
                    };
                    let expected: Vec<f32> = start.iter().enumerate().map(sum).collect();
                    // The tiles of this CPU, and those of both widths.
                    for add in [add_product, add_narrow, add_wide] {
                        let mut found = start.clone();
                        add(&mut found, left, &packed);
                        assert_eq!(found, expected, "{rows} x {depth} x {columns}");
                    }
                }
            }
        }
    }

    fn add_narrow(sum: &mut [f32], left: Matrix, right: &Packed) {
        compute_blocks_with::<1>(sum, Start::Result, left, right);
    }

    fn add_wide(sum: &mut [f32], left: Matrix, right: &Packed) {
        compute_blocks_with::<2>(sum, Start::Result, left, right);
    }
}
