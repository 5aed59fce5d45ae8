//! Parameter names in a request of `dynamic_reconfigure/Reconfigure` (ROS 1), without their values.

/// Returns the concatenated names that a request sets; `None` if it is no such request. Clients send some parameters of
/// a node, or all of them.
pub fn parameter_names(request: &[u8]) -> Option<Vec<u8>> {
    let mut rest = ByteReader(request);
    let mut names = Vec::new();
    // bools, ints, strs, doubles; then groups, which set nothing themselves.
    for value in [Some(1), Some(4), None, Some(8)] {
        for _ in 0..rest.number()? {
            names.extend_from_slice(rest.text()?);
            names.push(0);
            match value {
                Some(bytes) => rest.take(bytes)?,
                None => rest.text()?,
            };
        }
    }
    for _ in 0..rest.number()? {
        rest.text()?;
        // state, id and parent
        rest.take(9)?;
    }
    rest.0.is_empty().then_some(names)
}

struct ByteReader<'a>(&'a [u8]);

impl<'a> ByteReader<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    fn number(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(self.take(4)?.try_into().ok()?))
    }

    fn text(&mut self) -> Option<&'a [u8]> {
        let length = self.number()?;
        self.take(usize::try_from(length).ok()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Vec<u8> {
        let length = u32::try_from(text.len()).unwrap().to_le_bytes();
        [&length, text.as_bytes()].concat()
    }

    /// Returns a request that sets a speed and a frame, in a group.
    fn request(speed: f64, frame: &str) -> Vec<u8> {
        let [none, one] = [0_u32, 1].map(u32::to_le_bytes);
        let strings = [&one[..], &text("frame"), &text(frame)].concat();
        let doubles = [&one[..], &text("speed"), &speed.to_le_bytes()].concat();
        let groups = [&one[..], &text("Default"), &[1], &none, &none].concat();
        [&none[..], &none, &strings, &doubles, &groups].concat()
    }

    #[test]
    fn the_same_parameters_have_the_same_names_whatever_their_values() {
        let whole = request(1.0, "map");
        assert_eq!(parameter_names(&whole).unwrap(), b"frame\0speed\0");
        assert_eq!(parameter_names(&request(2.0, "odom")), parameter_names(&whole));
        // A truncated or longer message is no request.
        for end in 0..whole.len() {
            assert_eq!(parameter_names(&whole[..end]), None, "{end}");
        }
        assert_eq!(parameter_names(&[&whole[..], &[0]].concat()), None);
        assert_eq!(parameter_names(&[255; 64]), None);
    }
}
