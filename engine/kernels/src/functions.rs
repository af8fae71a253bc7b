//! Exponential functions that compile to vector instructions.
//!
//! `exp(x)` is `2^n exp(r)` with `x = n ln 2 + r` and `|r| <= ln 2 / 2` (Cody and Waite, 1980). The polynomial for `exp(r)` is that of
//! `expf` in Moshier's Cephes library. Errors are at most 3e-7 of the result.

/// The parts `2^n` and `exp(r) - 1` of `exp(x)`. NaN stays NaN.
#[inline(always)]
fn scale_and_rest(x: f32) -> (f32, f32) {
    // Adding 1.5 * 2^23 rounds to an integer, which is then in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    // The results are finite and normal in this range.
    let x = x.clamp(-87.0, 88.0);
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    // ln 2 in two parts, the first with so few bits that its product with n is exact.
    let r = n.mul_add(2.121_944_4e-4, n.mul_add(-0.693_359_4, x));
    let p = 1.987_569_1e-4_f32
        .mul_add(r, 1.398_2e-3)
        .mul_add(r, 8.333_452e-3)
        .mul_add(r, 4.166_579_6e-2)
        .mul_add(r, 1.666_666_5e-1)
        .mul_add(r, 0.5);
    (f32::from_bits(shifted.to_bits().wrapping_add(127) << 23), (r * r).mul_add(p, r))
}

/// `exp(x)`, for `x` from -87 to 88; beyond, the value at the bound.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let (scale, rest) = scale_and_rest(x);
    scale.mul_add(rest, scale)
}

/// `exp(x) - 1`, with a small relative error near 0, too.
#[inline(always)]
fn exp_minus_one(x: f32) -> f32 {
    let (scale, rest) = scale_and_rest(x);
    scale.mul_add(rest, scale - 1.0)
}

/// The logistic function, `1 / (1 + exp(-x))`.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// The hyperbolic tangent, `(exp(2 x) - 1) / (exp(2 x) + 1)`.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    let e = exp_minus_one(2.0 * x);
    e / (e + 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The largest error relative to `of(exact)`, over `x` from -30 to 30 and close to 0.
    fn error(function: fn(f32) -> f32, exact: fn(f64) -> f64) -> f64 {
        let numbers = (-30_000..=30_000).flat_map(|i| [i as f32 * 1e-3, i as f32 * 1e-9]);
        let errors = numbers.filter(|x| *x != 0.0).map(|x| {
            let exact = exact(f64::from(x));
            ((f64::from(function(x)) - exact) / exact).abs()
        });
        errors.fold(0.0, f64::max)
    }

    #[test]
    fn errors_are_at_most_three_in_ten_million() {
        assert!(error(exp, f64::exp) < 3e-7, "{}", error(exp, f64::exp));
        assert!(error(tanh, f64::tanh) < 3e-7, "{}", error(tanh, f64::tanh));
        let logistic = |x: f64| 1.0 / (1.0 + (-x).exp());
        assert!(error(sigmoid, logistic) < 3e-7, "{}", error(sigmoid, logistic));
    }

    #[test]
    fn extreme_numbers_saturate_and_nan_stays_nan() {
        for (x, limits) in [(f32::INFINITY, [1.0, 1.0]), (1e30, [1.0, 1.0]), (f32::NEG_INFINITY, [0.0, -1.0])] {
            assert!((sigmoid(x) - limits[0]).abs() < 1e-30 && tanh(x) == limits[1], "{x}: {} {}", sigmoid(x), tanh(x));
        }
        assert!(exp(f32::NAN).is_nan() && sigmoid(f32::NAN).is_nan() && tanh(f32::NAN).is_nan());
        assert_eq!((exp(0.0), sigmoid(0.0), tanh(0.0)), (1.0, 0.5, 0.0));
    }
}
