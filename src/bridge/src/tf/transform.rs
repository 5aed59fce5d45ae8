//! Rigid transforms.

/// A rotation (unit quaternion x, y, z, w) followed by a translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Transform {
    pub(crate) translation: [f64; 3],
    pub(crate) rotation: [f64; 4],
}

impl Transform {
    pub(crate) const IDENTITY: Transform = Transform { translation: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0] };

    /// Returns the composition: first `other`, then this transform.
    pub(crate) fn compose(&self, other: &Transform) -> Transform {
        let moved = rotate(self.rotation, other.translation);
        Transform {
            translation: std::array::from_fn(|at| moved[at] + self.translation[at]),
            rotation: multiply(self.rotation, other.rotation),
        }
    }

    pub(crate) fn inverse(&self) -> Transform {
        let [x, y, z, w] = self.rotation;
        let rotation = [-x, -y, -z, w];
        Transform { translation: rotate(rotation, self.translation).map(|length| -length), rotation }
    }

    /// Returns the distance between two transforms: metres, radians.
    pub(crate) fn distance(&self, other: &Transform) -> (f64, f64) {
        let squares = (0..3).map(|at| (self.translation[at] - other.translation[at]).powi(2));
        let dot: f64 = (0..4).map(|at| self.rotation[at] * other.rotation[at]).sum();
        (squares.sum::<f64>().sqrt(), 2.0 * dot.abs().min(1.0).acos())
    }

    /// Returns the transform with a normalized rotation; `None` if that is impossible.
    pub(crate) fn normalize(mut self) -> Option<Transform> {
        let length = self.rotation.iter().map(|part| part * part).sum::<f64>().sqrt();
        let finite = self.translation.iter().all(|part| part.is_finite());
        if !finite || !length.is_finite() || length < 1e-6 {
            return None;
        }
        self.rotation = self.rotation.map(|part| part / length);
        Some(self)
    }
}

fn multiply(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    ]
}

fn rotate(rotation: [f64; 4], vector: [f64; 3]) -> [f64; 3] {
    let [x, y, z, w] = rotation;
    let pure = [vector[0], vector[1], vector[2], 0.0];
    let [x, y, z, _] = multiply(multiply(rotation, pure), [-x, -y, -z, w]);
    [x, y, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A quarter turn to the left, then a step of one forward (x).
    const TURN: Transform = Transform {
        translation: [1.0, 0.0, 0.0],
        rotation: [0.0, 0.0, std::f64::consts::FRAC_1_SQRT_2, std::f64::consts::FRAC_1_SQRT_2],
    };

    #[track_caller]
    fn assert_close(one: &Transform, other: &Transform) {
        let (metres, radians) = one.distance(other);
        assert!(metres < 1e-9 && radians < 1e-6, "{one:?} {other:?}");
    }

    #[test]
    fn transforms_are_chained_and_undone() {
        let twice = TURN.compose(&TURN);
        assert_close(&twice, &Transform { translation: [1.0, 1.0, 0.0], rotation: [0.0, 0.0, 1.0, 0.0] });
        assert_close(&twice.compose(&twice.inverse()), &Transform::IDENTITY);
        assert_close(&TURN.inverse().compose(&TURN), &Transform::IDENTITY);
    }

    #[test]
    fn distances_are_metres_and_radians() {
        let (metres, radians) = TURN.distance(&Transform::IDENTITY);
        assert!((metres - 1.0).abs() < 1e-9);
        assert!((radians - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
    }

    #[test]
    fn what_is_no_rotation_is_refused() {
        let flat = Transform { rotation: [0.0; 4], ..TURN };
        assert_eq!(flat.normalize(), None);
        let far = Transform { translation: [f64::NAN, 0.0, 0.0], ..TURN };
        assert_eq!(far.normalize(), None);
        let long = Transform { rotation: [0.0, 0.0, 0.0, 7.0], ..TURN };
        assert_eq!(long.normalize().unwrap().rotation, [0.0, 0.0, 0.0, 1.0]);
    }
}
