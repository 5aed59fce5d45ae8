//! Damaged frames: every frame is parsed or refused without panicking, and what was parsed can be printed and parsed
//! again.

use std::time::{Duration, Instant};

use rosbridge::{Format, FragmentLimits, Fragments, Op, Payload, ProtocolFrame, decode_png, unknown_fields};

const FRAMES: &[&str] = &[
    r#"{"op":"publish","id":"p:1","topic":"/a/b","msg":{"data":"x\"\\y\u00fc","n":[1,-2.5e3,true,null]},"latch":false}"#,
    r#"{"op":"fragment","id":7,"data":"{\"op\":","num":0,"total":2}"#,
    r#"{"op":"png","id":"x","data":"iVBORw0KGgo=","num":1,"total":3}"#,
    r#"{"op":"call_service","id":"c","service":"/add#3","type":"a/B","args":[1,{"b":[2]}],"timeout":2.5,"fragment_size":10,"compression":"cbor-raw"}"#,
    r#"{"op":"service_response","id":"c","service":"/add","values":{"sum":3},"result":true}"#,
    r#"{"op":"subscribe","id":"s","topic":"/t","type":"a/B","throttle_rate":100,"queue_length":2,"fragment_size":1000,"compression":"png","qos":{"history":"keep_last","depth":5,"reliability":2,"durability":"volatile","deadline":0.5,"lifespan":{"sec":1,"nanosec":2},"liveliness":"automatic","liveliness_lease_duration":"infinite"}}"#,
    r#"{"op":"unsubscribe","id":"s","topic":"/t"}"#,
    r#"{"op":"advertise","topic":"/t","type":"a/B","latch":true,"queue_size":5,"md5sum":"0123","qos":{"durability":"transient_local"}}"#,
    r#"{"op":"send_action_goal","id":"g","action":"/f","action_type":"a/F","args":{"order":5},"feedback":true}"#,
    r#"{"op":"action_result","id":"g","action":"/f","values":{"s":[1]},"status":4,"result":true}"#,
    r#"{"op":"set_level","level":"warning"}"#,
    r#"{"op":"auth","mac":"a","client":"b","dest":"c","rand":"d","t":1,"level":"e","end":2}"#,
];

/// Deterministic pseudo-random numbers (xorshift64).
struct Dice(u64);

impl Dice {
    fn next_below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % limit as u64) as usize
    }

    /// Changes, removes, repeats or inserts a few bytes.
    fn damage(&mut self, bytes: &mut Vec<u8>) {
        const BYTES: &[u8] = b"{}[]\",:\\u0-1.eE+tfn \x00\x1f\x7f\x80\xbf\xc3\xff\x5b\x7b\x9b\xbb\x9f\xbf\xd8\xf9";
        for _ in 0..=self.next_below(4) {
            let at = self.next_below(bytes.len() + 1);
            let byte = BYTES[self.next_below(BYTES.len())];
            match self.next_below(4) {
                0 if at < bytes.len() => bytes[at] = byte,
                1 if at < bytes.len() => drop(bytes.remove(at)),
                2 => {
                    let end = (at + self.next_below(12)).min(bytes.len());
                    let piece = bytes[at..end].to_vec();
                    bytes.splice(at..at, piece);
                }
                _ => bytes.insert(at, byte),
            }
        }
    }
}

/// Asserts that a parsed op can be printed and parsed again.
fn assert_round_trip(op: &Op<'_>, format: Format) {
    let mut printed = Vec::new();
    op.print(&mut printed, format);
    let frame = match format {
        Format::Json => ProtocolFrame::Text(std::str::from_utf8(&printed).expect("JSON is UTF-8")),
        Format::Cbor => ProtocolFrame::Binary(&printed),
    };
    assert_eq!(Op::parse(frame).as_ref(), Ok(op), "{printed:?}");
}

fn payload_of<'a>(op: &Op<'a>) -> Option<Payload<'a>> {
    match op {
        Op::Publish(op) => Some(op.msg),
        Op::CallService(op) => op.args,
        Op::ServiceResponse(op) => op.values,
        Op::SendActionGoal(op) => op.args,
        Op::ActionResult(op) => op.values,
        _ => None,
    }
}

fn try_all(frame: ProtocolFrame<'_>, fragments: &mut Fragments) -> bool {
    let Ok(op) = Op::parse(frame) else {
        return false;
    };
    assert_round_trip(&op, frame.format());
    unknown_fields(frame);
    if let Some(payload) = payload_of(&op) {
        let _ = (payload.raw(), payload.text(), payload.to_named_object(["a", "b", "c"]));
    }
    match op {
        Op::Fragment(fragment) => drop(fragments.add(&fragment, Instant::now())),
        Op::Png(png) => drop(decode_png(&png.data, 10_000)),
        _ => {}
    }
    true
}

#[test]
fn damaged_json_is_read_or_refused() {
    let limits = FragmentLimits { messages: 4, parts: 100, bytes: 10_000, age: Duration::from_secs(60) };
    let (mut dice, mut fragments, mut read) = (Dice(0x9e37_79b9_7f4a_7c15), Fragments::new(limits), 0);
    for round in 0..60_000 {
        let mut bytes = FRAMES[round % FRAMES.len()].as_bytes().to_vec();
        dice.damage(&mut bytes);
        let text = String::from_utf8_lossy(&bytes);
        read += usize::from(try_all(ProtocolFrame::Text(&text), &mut fragments));
        assert!(fragments.bytes() <= 10_000 + 4 * 100 * 16);
    }
    assert!(read > 1000, "some survive: {read}");
}

#[test]
fn damaged_cbor_is_read_or_refused() {
    let (mut dice, mut fragments, mut read) = (Dice(42), Fragments::new(FragmentLimits::default()), 0);
    let frames: Vec<Vec<u8>> = FRAMES.iter().filter_map(|text| to_cbor(text)).collect();
    assert!(frames.len() >= 8);
    for round in 0..60_000 {
        let mut bytes = frames[round % frames.len()].clone();
        dice.damage(&mut bytes);
        read += usize::from(try_all(ProtocolFrame::Binary(&bytes), &mut fragments));
    }
    assert!(read > 1000, "some survive: {read}");
}

/// Converts ops whose payloads can be printed without a codec: none, or a map made here.
fn to_cbor(text: &str) -> Option<Vec<u8>> {
    const MAP: Payload<'static> = Payload { format: Format::Cbor, bytes: b"\xa2\x61a\x01\x65bytes\x43\x01\x02\x03" };
    let mut op = Op::parse(ProtocolFrame::Text(text)).ok()?;
    match &mut op {
        Op::Publish(op) => op.msg = MAP,
        Op::CallService(op) => op.args = Some(MAP),
        Op::ServiceResponse(op) => op.values = Some(MAP),
        Op::SendActionGoal(op) => op.args = Some(MAP),
        Op::ActionResult(op) => op.values = Some(MAP),
        _ => {}
    }
    let mut out = Vec::new();
    op.print(&mut out, Format::Cbor);
    Some(out)
}
