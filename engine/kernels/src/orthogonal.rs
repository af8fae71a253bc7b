//! Orthogonal initial weights (Saxe et al., 2014), as `torch.nn.init.orthogonal_`.

/// Replaces standard normal numbers, a weight (rows, columns), by `gain` times an orthonormal matrix: its rows are orthonormal, or its
/// columns if there are more rows than columns.
///
/// Gram and Schmidt's method, which gives the factor Q of the QR decomposition with a positive diagonal of R. It runs twice, since once
/// loses orthogonality by rounding (Giraud et al., 2005). Panics if the numbers do not fill the columns.
pub fn orthogonal(weight: &mut [f32], columns: usize, gain: f32) {
    assert_eq!(weight.len() % columns, 0);
    let rows = weight.len() / columns;
    // Vector i is row i, or column i if there are more rows.
    let (count, size) = (rows.min(columns), rows.max(columns));
    let index = |i: usize, j: usize| if rows > columns { j * columns + i } else { i * columns + j };
    let mut vectors: Vec<Vec<f64>> = Vec::with_capacity(count);
    for i in 0..count {
        let mut vector: Vec<f64> = (0..size).map(|j| f64::from(weight[index(i, j)])).collect();
        for before in vectors.iter().chain(&vectors) {
            let product = dot(before, &vector);
            vector.iter_mut().zip(before).for_each(|(x, before)| *x -= product * before);
        }
        let norm = dot(&vector, &vector).sqrt();
        vector.iter_mut().for_each(|x| *x /= norm);
        vector.iter().enumerate().for_each(|(j, x)| weight[index(i, j)] = (f64::from(gain) * x) as f32);
        vectors.push(vector);
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
