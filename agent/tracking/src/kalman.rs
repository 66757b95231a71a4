//! Kalman filter of an object that moves at constant velocity in the ground plane.

use nalgebra::{Matrix2, Matrix2x4, Matrix4, Vector2, Vector4};

/// Position and velocity with their covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConstantVelocity {
    /// x, y in metres, then their rates in metres per second.
    pub state: Vector4<f64>,
    /// Covariance of `state`.
    pub covariance: Matrix4<f64>,
}

/// A measured position minus the predicted one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    /// Difference, metres.
    pub residual_m: Vector2<f64>,
    /// Inverse of its covariance, 1 / square metres.
    pub information: Matrix2<f64>,
    /// Logarithm of the determinant of its covariance in square metres.
    pub log_determinant: f64,
}

impl Innovation {
    /// Squared Mahalanobis distance, chi-square distributed with two degrees of freedom.
    pub fn mahalanobis_squared(&self) -> f64 {
        self.residual_m.dot(&(self.information * self.residual_m))
    }
}

impl ConstantVelocity {
    /// An object at a measured position, of unknown velocity with this standard deviation in each direction.
    pub fn at(position_m: Vector2<f64>, noise_m2: &Matrix2<f64>, sigma_mps: f64) -> Self {
        let mut covariance = Matrix4::zeros();
        covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(noise_m2);
        let mut of_velocity = covariance.fixed_view_mut::<2, 2>(2, 2);
        of_velocity.fill_diagonal(sigma_mps * sigma_mps);
        let state = Vector4::new(position_m.x, position_m.y, 0.0, 0.0);
        Self { state, covariance }
    }

    /// Position, metres.
    pub fn position_m(&self) -> Vector2<f64> {
        self.state.fixed_rows::<2>(0).into()
    }

    /// Velocity, metres per second.
    pub fn velocity_mps(&self) -> Vector2<f64> {
        self.state.fixed_rows::<2>(2).into()
    }

    /// Moves on by a time, during which the acceleration in each direction is constant, of mean 0 and this standard
    /// deviation (Bar-Shalom, Li and Kirubarajan 2001, Section 6.3.2).
    pub fn predict(&mut self, elapsed_s: f64, acceleration_mps2: f64) {
        let mut transition = Matrix4::identity();
        (transition[(0, 2)], transition[(1, 3)]) = (elapsed_s, elapsed_s);
        let variance = acceleration_mps2 * acceleration_mps2;
        // Noise: variance * G G^T with G = [t^2 / 2, t].
        let [of_position, mixed, of_velocity] = [
            elapsed_s.powi(4) / 4.0,
            elapsed_s.powi(3) / 2.0,
            elapsed_s.powi(2),
        ];
        let of_axis = Matrix2::new(of_position, mixed, mixed, of_velocity) * variance;
        let noise = of_axis.kronecker(&Matrix2::identity());
        self.state = transition * self.state;
        self.covariance = transition * self.covariance * transition.transpose() + noise;
    }

    /// A measured position compared with the state; `None` if the covariance of the difference has no inverse.
    pub fn innovation(
        &self,
        position_m: Vector2<f64>,
        noise_m2: &Matrix2<f64>,
    ) -> Option<Innovation> {
        let covariance = self.covariance.fixed_view::<2, 2>(0, 0) + noise_m2;
        let determinant = covariance.determinant();
        Some(Innovation {
            residual_m: position_m - self.position_m(),
            // With a negative determinant there is an inverse, but no covariance.
            information: covariance.try_inverse().filter(|_| determinant > 0.0)?,
            log_determinant: determinant.ln(),
        })
    }

    /// Takes a measured position in. The covariance is updated in Joseph's form, which keeps it symmetric and positive.
    pub fn correct(&mut self, innovation: &Innovation, noise_m2: &Matrix2<f64>) {
        // Gain P H^T S^-1, where H = [I 0] measures the position.
        let gain = self.covariance.fixed_view::<4, 2>(0, 0) * innovation.information;
        let rest = Matrix4::identity() - gain * Matrix2x4::<f64>::identity();
        self.state += gain * innovation.residual_m;
        self.covariance =
            rest * self.covariance * rest.transpose() + gain * noise_m2 * gain.transpose();
    }
}
