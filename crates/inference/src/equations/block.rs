//! Series of residuals, columns that may explain them, and the noise that remains: white plus an Ornstein-Uhlenbeck process.

/// Series of residuals of one channel in one regime.
#[derive(Clone, Debug)]
pub struct Block {
    /// Name, such as `torque FL_calf hang`.
    pub name: String,
    /// Time of each row [s], increasing.
    pub t: Vec<f64>,
    /// Measured minus modelled.
    pub y: Vec<f64>,
    /// Standard deviation of the sensor's noise in a row.
    pub sigma: f64,
}

/// What an unknown changes in each block, per unit of the unknown. A block has at most one part.
#[derive(Clone, Debug, Default)]
pub struct Column {
    /// Index of a block, and the change of its residuals.
    pub parts: Vec<(usize, Vec<f64>)>,
}

impl Column {
    /// Returns true if the column changes nothing.
    pub fn is_zero(&self) -> bool {
        self.parts.iter().all(|(_, rows)| rows.iter().all(|row| *row == 0.0))
    }

    /// Adds another column.
    pub fn add(&mut self, other: &Self) {
        for (block, rows) in &other.parts {
            match self.parts.iter_mut().find(|(own, _)| own == block) {
                Some((_, own)) => own.iter_mut().zip(rows).for_each(|(own, row)| *own += row),
                None => self.parts.push((*block, rows.clone())),
            }
        }
    }

    /// Returns the column times a number.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        let scaled = |rows: &Vec<f64>| rows.iter().map(|row| factor * row).collect();
        Self { parts: self.parts.iter().map(|(block, rows)| (*block, scaled(rows))).collect() }
    }
}

/// Correlation of what a model lacks: correlation time [s], and variance relative to that of the noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Correlation time [s].
    pub time: f64,
    /// Variance relative to that of the white noise.
    pub ratio: f64,
}

/// The shapes that are compared. The first is white noise.
pub const SHAPES: [Shape; 10] = [
    shape(0.1, 0.0),
    shape(0.02, 0.3),
    shape(0.02, 3.0),
    shape(0.02, 100.0),
    shape(0.1, 0.3),
    shape(0.1, 3.0),
    shape(0.1, 100.0),
    shape(0.5, 0.3),
    shape(0.5, 3.0),
    shape(0.5, 100.0),
];

const fn shape(time: f64, ratio: f64) -> Shape {
    Shape { time, ratio }
}

/// Filter that makes noise of a shape white (the innovations of its Kalman filter), in units of the sensor's noise.
#[derive(Clone, Debug)]
pub struct Whitener {
    /// Decay of the correlated part since the row before, gain of the filter, and inverse standard deviation of the innovation.
    rows: Vec<[f64; 3]>,
    sigma: f64,
    /// Logarithm of the determinant of the covariance.
    pub log_determinant: f64,
}

impl Whitener {
    /// Computes the filter for the rows of a block.
    pub fn new(block: &Block, shape: Shape) -> Self {
        let (mut variance, mut log_determinant) = (shape.ratio, 0.0);
        let mut rows = Vec::with_capacity(block.t.len());
        for row in 0..block.t.len() {
            let gap = if row == 0 { f64::INFINITY } else { block.t[row] - block.t[row - 1] };
            let decay = (-gap / shape.time).exp();
            let predicted = decay * decay * variance + shape.ratio * (1.0 - decay * decay);
            let innovation = predicted + 1.0;
            let gain = predicted / innovation;
            variance = (1.0 - gain) * predicted;
            log_determinant += innovation.ln();
            rows.push([decay, gain, innovation.sqrt().recip()]);
        }
        Self { rows, sigma: block.sigma, log_determinant }
    }

    /// Returns the white series.
    pub fn whiten(&self, series: &[f64]) -> Vec<f64> {
        let mut state = 0.0;
        let mut white = Vec::with_capacity(series.len());
        for (value, [decay, gain, scale]) in series.iter().zip(&self.rows) {
            state *= decay;
            let innovation = value / self.sigma - state;
            state += gain * innovation;
            white.push(scale * innovation);
        }
        white
    }

    /// Returns the series times the inverse of the covariance: the scalar product with another series is that of both white series.
    pub fn weighted(&self, series: &[f64]) -> Vec<f64> {
        let mut weighted = self.whiten(series);
        // The transpose of the filter runs backwards.
        let mut state = 0.0;
        for (value, [decay, gain, scale]) in weighted.iter_mut().zip(&self.rows).rev() {
            let innovation = scale * *value + gain * state;
            state = decay * (state - innovation);
            *value = innovation / self.sigma;
        }
        weighted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whitener_has_the_determinant_and_the_inverse_of_the_covariance() {
        let block = Block {
            name: String::new(),
            t: vec![0.0, 0.1, 0.25, 0.3, 0.9],
            y: vec![1.0, -0.5, 0.3, 0.8, -1.2],
            sigma: 0.5,
        };
        let shape = Shape { time: 0.2, ratio: 2.0 };
        let entry = |row: usize, column: usize| {
            let gap: f64 = block.t[row] - block.t[column];
            let white = if row == column { 1.0 } else { 0.0 };
            white + shape.ratio * (-gap.abs() / shape.time).exp()
        };
        let covariance = nalgebra::DMatrix::from_fn(5, 5, entry);
        let y = nalgebra::DVector::from_iterator(5, block.y.iter().map(|value| value / block.sigma));
        let expected = (y.transpose() * covariance.clone().try_inverse().expect("regular") * &y)[0];
        let whitener = Whitener::new(&block, shape);
        let white = whitener.whiten(&block.y);
        assert!((white.iter().map(|value| value * value).sum::<f64>() - expected).abs() < 1e-9);
        assert!((whitener.log_determinant - covariance.determinant().ln()).abs() < 1e-9);
        let other = [0.3, 1.0, -0.7, 0.2, 0.9];
        let product: f64 = white.iter().zip(whitener.whiten(&other)).map(|(one, other)| one * other).sum();
        let weighted: f64 = whitener.weighted(&block.y).iter().zip(other).map(|(one, other)| one * other).sum();
        assert!((product - weighted).abs() < 1e-9);
    }
}
