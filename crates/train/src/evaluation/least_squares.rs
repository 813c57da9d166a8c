//! What fits by least squares need: systems of linear equations with a symmetric positive matrix,
//! solved by Cholesky's factorization. Matrices are row by row. nalgebra's factorization adds in another order, so that scores
//! and calibrations would get other last digits.

/// The means of the products of each two of the N values of a row.
pub(super) fn second_moments<const N: usize>(rows: &[[f64; N]]) -> Vec<f64> {
    let mut moments = vec![0.0; N * N];
    for row in rows {
        for (place, sum) in moments.iter_mut().enumerate() {
            *sum += row[place / N] * row[place % N] / rows.len() as f64;
        }
    }
    moments
}

/// The lower triangular L with L · Lᵀ = the matrix of `size` rows, plus `ridge` on its diagonal; none if that is not positive.
pub(super) fn factor(matrix: &[f64], size: usize, ridge: f64) -> Option<Vec<f64>> {
    let mut factor = vec![0.0; size * size];
    for i in 0..size {
        for j in 0..=i {
            let dot: f64 = (0..j).map(|k| factor[i * size + k] * factor[j * size + k]).sum();
            let value = matrix[i * size + j];
            factor[i * size + j] = if i == j {
                let rest = value + ridge - dot;
                (rest > 0.0).then_some(rest.sqrt())?
            } else {
                (value - dot) / factor[j * size + j]
            };
        }
    }
    Some(factor)
}

/// L⁻¹ · x for the lower triangular L.
pub(super) fn forward(factor: &[f64], mut x: Vec<f64>) -> Vec<f64> {
    let size = x.len();
    for i in 0..size {
        let dot: f64 = (0..i).map(|k| factor[i * size + k] * x[k]).sum();
        x[i] = (x[i] - dot) / factor[i * size + i];
    }
    x
}

/// The x with L · Lᵀ · x = `right_side`.
pub(super) fn solve(factor: &[f64], right_side: Vec<f64>) -> Vec<f64> {
    let mut x = forward(factor, right_side);
    let size = x.len();
    for i in (0..size).rev() {
        let dot: f64 = (i + 1..size).map(|k| factor[k * size + i] * x[k]).sum();
        x[i] = (x[i] - dot) / factor[i * size + i];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_solution_solves_its_equations() {
        let matrix = [4.0, 1.0, 1.0, 3.0];
        let x = solve(&factor(&matrix, 2, 0.0).unwrap(), vec![1.0, 2.0]);
        assert!((4.0 * x[0] + x[1] - 1.0).abs() < 1e-12 && (x[0] + 3.0 * x[1] - 2.0).abs() < 1e-12);
        assert_eq!(factor(&[1.0, 2.0, 2.0, 1.0], 2, 0.0), None);
    }
}
