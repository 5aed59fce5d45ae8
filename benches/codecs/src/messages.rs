//! Serialized ROS 1 messages.

/// A serialized message, written field by field.
#[derive(Default)]
pub struct MessageWriter(Vec<u8>);

impl MessageWriter {
    /// Starts a message with a `std_msgs/Header`.
    fn with_header(sequence: u32, frame: &str) -> Self {
        Self::default().u32(sequence).u32(1_700_000_000).u32(123_456_789).text(frame)
    }

    fn u8(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    fn f32(self, value: f32) -> Self {
        self.u32(value.to_bits())
    }

    fn f64(mut self, value: f64) -> Self {
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    fn text(self, text: &str) -> Self {
        self.bytes(text.as_bytes())
    }

    fn bytes(mut self, bytes: &[u8]) -> Self {
        self = self.u32(bytes.len() as u32);
        self.0.extend_from_slice(bytes);
        self
    }

    fn floats(self, values: &[f32]) -> Self {
        values.iter().fold(self.u32(values.len() as u32), |message, &value| message.f32(value))
    }
}

/// Serializes a `sensor_msgs/Image`; `step` is the length of the data per row.
pub fn image(encoding: &str, width: usize, height: usize, data: &[u8]) -> Vec<u8> {
    let step = (data.len() / height) as u32;
    let message = MessageWriter::with_header(7, "camera_rgb_optical_frame").u32(height as u32).u32(width as u32);
    message.text(encoding).u8(0).u32(step).bytes(data).0
}

/// Serializes a `nav_msgs/OccupancyGrid` of 0.05 m cells around the origin.
pub fn grid(width: usize, height: usize, cells: &[u8]) -> Vec<u8> {
    let message = MessageWriter::with_header(1, "map").u32(1_700_000_000).u32(0).f32(0.05);
    let message = message.u32(width as u32).u32(height as u32);
    let pose = [-100.0, -100.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    pose.into_iter().fold(message, MessageWriter::f64).bytes(cells).0
}

/// Serializes a `sensor_msgs/LaserScan` over 270 degrees.
pub fn scan(ranges: &[f32], intensities: &[f32]) -> Vec<u8> {
    let increment = 1.5 * std::f32::consts::PI / ranges.len() as f32;
    let limits = [-0.75 * std::f32::consts::PI, 0.75 * std::f32::consts::PI, increment, 0.0, 0.025, 0.05, 30.0];
    let message = limits.into_iter().fold(MessageWriter::with_header(3, "laser"), MessageWriter::f32);
    message.floats(ranges).floats(intensities).0
}

/// Type of a point field, with the numbers of `sensor_msgs/PointField`.
#[derive(Clone, Copy)]
pub enum PointFieldType {
    U16 = 4,
    F32 = 7,
}

/// Serializes a `sensor_msgs/PointCloud2` without row padding.
pub fn cloud(
    width: usize,
    height: usize,
    step: usize,
    fields: &[(&str, usize, PointFieldType)],
    data: &[u8],
) -> Vec<u8> {
    let mut message = MessageWriter::with_header(9, "camera_depth_optical_frame").u32(height as u32).u32(width as u32);
    message = message.u32(fields.len() as u32);
    for &(name, offset, number) in fields {
        message = message.text(name).u32(offset as u32).u8(number as u8).u32(1);
    }
    message.u8(0).u32(step as u32).u32((step * width) as u32).bytes(data).u8(0).0
}
