//! Vectors, inertias and Cholesky factors of a batch of robots, one per SIMD lane.

use std::ops::{Add, Neg, Sub};

use glam::{DMat3, DVec3};

use twinstep_model::RigidBody;
use twinstep_simd::SimdFloat;

/// Vector in three dimensions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vec3<T>(pub [T; 3]);

impl<T: SimdFloat> Vec3<T> {
    /// Returns `value` in every lane.
    #[inline(always)]
    pub fn splat(value: DVec3) -> Self {
        Self([T::splat(value.x), T::splat(value.y), T::splat(value.z)])
    }

    /// Sets the vector of one robot.
    pub fn set(&mut self, lane: usize, value: DVec3) {
        for (component, value) in self.0.iter_mut().zip(value.to_array()) {
            component.set(lane, value);
        }
    }

    /// Returns the zero vector.
    #[inline(always)]
    pub fn zero() -> Self {
        Self([T::splat(0.0); 3])
    }

    /// Returns the dot product.
    #[inline(always)]
    pub fn dot(self, other: Self) -> T {
        self.0[0] * other.0[0] + self.0[1] * other.0[1] + self.0[2] * other.0[2]
    }

    /// Returns the cross product.
    #[inline(always)]
    pub fn cross(self, other: Self) -> Self {
        let ([a, b, c], [x, y, z]) = (self.0, other.0);
        Self([b * z - c * y, c * x - a * z, a * y - b * x])
    }

    /// Returns the vector multiplied by `factor`.
    #[inline(always)]
    pub fn scaled(self, factor: T) -> Self {
        Self([self.0[0] * factor, self.0[1] * factor, self.0[2] * factor])
    }

    /// Returns the vector rotated about x by the angle with this sine and cosine.
    #[inline(always)]
    pub fn rotate_x(self, (s, c): (T, T)) -> Self {
        let [x, y, z] = self.0;
        Self([x, c * y - s * z, s * y + c * z])
    }

    /// Returns the vector rotated about x by the negative of the angle.
    #[inline(always)]
    pub fn rotate_x_inverse(self, (s, c): (T, T)) -> Self {
        self.rotate_x((-s, c))
    }

    /// Returns the vector rotated about y by the angle with this sine and cosine.
    #[inline(always)]
    pub fn rotate_y(self, (s, c): (T, T)) -> Self {
        let [x, y, z] = self.0;
        Self([c * x + s * z, y, c * z - s * x])
    }
}

impl<T: SimdFloat> Add for Vec3<T> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self([self.0[0] + other.0[0], self.0[1] + other.0[1], self.0[2] + other.0[2]])
    }
}

impl<T: SimdFloat> Sub for Vec3<T> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self([self.0[0] - other.0[0], self.0[1] - other.0[1], self.0[2] - other.0[2]])
    }
}

impl<T: SimdFloat> Neg for Vec3<T> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self([-self.0[0], -self.0[1], -self.0[2]])
    }
}

/// Mass, first moment `m c` and moments of inertia about the frame's origin, in which the dynamics are linear.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inertia<T> {
    /// Mass [kg].
    pub mass: T,
    /// Mass times centre of mass [kg·m].
    pub moment: Vec3<T>,
    /// Moments of inertia about the origin: xx, yy, zz, xy, xz, yz [kg·m²].
    pub about_origin: [T; 6],
}

impl<T: SimdFloat> Inertia<T> {
    /// Returns the inertia of `body` in every lane.
    pub fn splat(body: &RigidBody) -> Self {
        let mut inertia = Self { mass: T::splat(0.0), moment: Vec3::zero(), about_origin: [T::splat(0.0); 6] };
        for lane in 0..T::LANES {
            inertia.set(lane, body);
        }
        inertia
    }

    /// Sets the body of one robot.
    pub fn set(&mut self, lane: usize, body: &RigidBody) {
        let (mass, c) = (body.mass, body.com);
        let outer = DMat3::from_cols(c * c.x, c * c.y, c * c.z);
        let about = body.inertia + (DMat3::from_diagonal(DVec3::splat(c.length_squared())) - outer) * mass;
        self.mass.set(lane, mass);
        for (component, value) in self.moment.0.iter_mut().zip((c * mass).to_array()) {
            component.set(lane, value);
        }
        let entries = [about.x_axis.x, about.y_axis.y, about.z_axis.z, about.y_axis.x, about.z_axis.x, about.z_axis.y];
        for (component, value) in self.about_origin.iter_mut().zip(entries) {
            component.set(lane, value);
        }
    }

    /// Returns the product of the inertia matrix about the origin and a vector.
    #[inline(always)]
    pub fn times(&self, v: Vec3<T>) -> Vec3<T> {
        let [xx, yy, zz, xy, xz, yz] = self.about_origin;
        let [x, y, z] = v.0;
        Vec3([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])
    }

    /// Returns the force [N] and the moment about the origin [N·m] of this motion, by the Newton–Euler equations.
    #[inline(always)]
    pub fn wrench(&self, omega: Vec3<T>, alpha: Vec3<T>, acceleration: Vec3<T>) -> (Vec3<T>, Vec3<T>) {
        let h = self.moment;
        let force = acceleration.scaled(self.mass) + alpha.cross(h) + omega.cross(omega.cross(h));
        let moment = self.times(alpha) + omega.cross(self.times(omega)) + h.cross(acceleration);
        (force, moment)
    }

    /// Returns the inertia of the body rotated about x by the angle with this sine and cosine.
    #[inline(always)]
    pub fn turned_x(&self, (s, c): (T, T)) -> Self {
        let [xx, yy, zz, xy, xz, yz] = self.about_origin;
        let (cc, ss, cs) = (c * c, s * s, c * s);
        let two_cross = (yz + yz) * cs;
        let about_origin = [
            xx,
            cc * yy + ss * zz - two_cross,
            ss * yy + cc * zz + two_cross,
            c * xy - s * xz,
            s * xy + c * xz,
            cs * (yy - zz) + (cc - ss) * yz,
        ];
        Self { mass: self.mass, moment: self.moment.rotate_x((s, c)), about_origin }
    }

    /// Returns the inertia of the body rotated about y by the angle with this sine and cosine.
    #[inline(always)]
    pub fn turned_y(&self, (s, c): (T, T)) -> Self {
        let [xx, yy, zz, xy, xz, yz] = self.about_origin;
        let (cc, ss, cs) = (c * c, s * s, c * s);
        let two_cross = (xz + xz) * cs;
        let about_origin = [
            cc * xx + ss * zz + two_cross,
            yy,
            ss * xx + cc * zz - two_cross,
            c * xy + s * yz,
            cs * (zz - xx) + (cc - ss) * xz,
            c * yz - s * xy,
        ];
        Self { mass: self.mass, moment: self.moment.rotate_y((s, c)), about_origin }
    }

    /// Returns the inertia in a parallel frame in which the body's origin is at `offset` [m].
    #[inline(always)]
    pub fn shifted(&self, offset: Vec3<T>) -> Self {
        let (m, h, r) = (self.mass, self.moment, offset);
        let two_rh = r.dot(h) + r.dot(h);
        let rr = r.dot(r) * m;
        let mut about_origin = self.about_origin;
        for k in 0..3 {
            let twice = r.0[k] * h.0[k] + r.0[k] * h.0[k];
            about_origin[k] = about_origin[k] + two_rh - twice + rr - m * r.0[k] * r.0[k];
        }
        for (entry, [i, j]) in [[0, 1], [0, 2], [1, 2]].into_iter().enumerate() {
            let cross = r.0[i] * h.0[j] + h.0[i] * r.0[j] + m * r.0[i] * r.0[j];
            about_origin[3 + entry] -= cross;
        }
        Self { mass: m, moment: h + r.scaled(m), about_origin }
    }

    /// Returns the inertia of two rigidly connected bodies.
    #[inline(always)]
    pub fn combined(&self, other: &Self) -> Self {
        let mut about_origin = self.about_origin;
        for (entry, more) in about_origin.iter_mut().zip(other.about_origin) {
            *entry += more;
        }
        Self { mass: self.mass + other.mass, moment: self.moment + other.moment, about_origin }
    }
}

/// Returns the lower triangle of a body's spatial inertia matrix (6 × 6): angular, then linear.
#[inline(always)]
pub fn spatial_matrix<T: SimdFloat>(body: &Inertia<T>) -> [[T; 6]; 6] {
    let zero = T::splat(0.0);
    let [xx, yy, zz, xy, xz, yz] = body.about_origin;
    let ([hx, hy, hz], m) = (body.moment.0, body.mass);
    [
        [xx, zero, zero, zero, zero, zero],
        [xy, yy, zero, zero, zero, zero],
        [xz, yz, zz, zero, zero, zero],
        // Force due to an angular acceleration: alpha × h.
        [zero, hz, -hy, m, zero, zero],
        [-hz, zero, hx, zero, m, zero],
        [hy, -hx, zero, zero, zero, m],
    ]
}

/// Cholesky factor of a symmetric positive definite matrix: `matrix = factor · factorᵀ`, `factor` lower triangular.
#[derive(Clone, Copy, Debug)]
pub struct Cholesky<T, const N: usize> {
    factor: [[T; N]; N],
    /// Reciprocal of each diagonal entry.
    inverse: [T; N],
}

impl<T: SimdFloat, const N: usize> Cholesky<T, N> {
    /// Returns a placeholder; overwritten before use.
    pub(crate) fn empty() -> Self {
        Self { factor: [[T::splat(0.0); N]; N], inverse: [T::splat(0.0); N] }
    }

    /// Factors `matrix`; reads only its lower triangle.
    #[inline(always)]
    pub fn new(mut matrix: [[T; N]; N]) -> Self {
        let mut inverse = [T::splat(0.0); N];
        for i in 0..N {
            for j in 0..=i {
                let mut sum = matrix[i][j];
                for k in 0..j {
                    sum -= matrix[i][k] * matrix[j][k];
                }
                if i == j {
                    let root = sum.sqrt();
                    matrix[i][i] = root;
                    inverse[i] = T::splat(1.0) / root;
                } else {
                    matrix[i][j] = sum * inverse[j];
                }
            }
        }
        Self { factor: matrix, inverse }
    }

    /// Returns `factor⁻¹ · vector`.
    #[inline(always)]
    pub fn forward(&self, mut vector: [T; N]) -> [T; N] {
        for i in 0..N {
            let mut sum = vector[i];
            for k in 0..i {
                sum -= self.factor[i][k] * vector[k];
            }
            vector[i] = sum * self.inverse[i];
        }
        vector
    }

    /// Returns `factor⁻ᵀ · vector`.
    #[inline(always)]
    pub fn backward(&self, mut vector: [T; N]) -> [T; N] {
        for i in (0..N).rev() {
            let mut sum = vector[i];
            for k in i + 1..N {
                sum -= self.factor[k][i] * vector[k];
            }
            vector[i] = sum * self.inverse[i];
        }
        vector
    }
}
