//! rosbridge: frames, fragments, PNG compression.

use std::time::{Duration, Instant};

use rosbridge::{
    Format, Fragment, FragmentLimits, Fragments, Id, Op, Payload, ProtocolFrame, decode_png, encode_png, unknown_fields,
};

/// A text frame.
pub fn json(data: &[u8]) {
    if let Ok(text) = std::str::from_utf8(data) {
        frame(ProtocolFrame::Text(text));
    }
}

/// A binary frame.
pub fn cbor(data: &[u8]) {
    frame(ProtocolFrame::Binary(data));
}

fn frame(frame: ProtocolFrame<'_>) {
    let Ok(op) = Op::parse(frame) else {
        return;
    };
    unknown_fields(frame);
    if let Some(payload) = payload(&op) {
        let _ = (payload.raw(), payload.text(), payload.to_named_object(["a", "data"]));
    }
    let mut printed = Vec::new();
    op.print(&mut printed, frame.format());
    let again = match frame.format() {
        Format::Json => ProtocolFrame::Text(std::str::from_utf8(&printed).expect("JSON is UTF-8")),
        Format::Cbor => ProtocolFrame::Binary(&printed),
    };
    assert_eq!(Op::parse(again).as_ref(), Ok(&op), "{printed:?}");
}

fn payload<'a>(op: &Op<'a>) -> Option<Payload<'a>> {
    match op {
        Op::Publish(op) => Some(op.msg),
        Op::CallService(op) => op.args,
        Op::ServiceResponse(op) => op.values,
        Op::SendActionGoal(op) => op.args,
        Op::ActionFeedback(op) => Some(op.values),
        Op::ActionResult(op) => op.values,
        _ => None,
    }
}

/// Fragments of several messages, in any order: five bytes each give message, index, total, time since the previous one
/// and length; the text follows.
pub fn fragments(mut data: &[u8]) {
    let limits = FragmentLimits { messages: 4, parts: 64, bytes: 2048, age: Duration::from_secs(100) };
    let mut fragments = Fragments::new(limits);
    let mut now = Instant::now();
    while let [id, num, total, wait, length, rest @ ..] = data {
        let (text, rest) = rest.split_at(usize::from(*length).min(rest.len()));
        data = rest;
        now += Duration::from_secs((*wait).into());
        let fragment = Fragment {
            id: Id::Integer(i64::from(*id % 8)),
            data: String::from_utf8_lossy(text),
            num: (*num).into(),
            total: (*total).into(),
        };
        let before = fragments.bytes();
        match fragments.add(&fragment, now) {
            Ok(Some(whole)) => {
                assert!(whole.ends_with(&*fragment.data) || fragment.num + 1 < fragment.total);
                assert!(fragments.bytes() <= before);
            }
            Ok(None) => assert!(fragment.num < fragment.total),
            Err(_) => {}
        }
        // The empty slots of one message may be added.
        assert!(fragments.bytes() <= limits.bytes + limits.parts * size_of::<Option<Box<str>>>());
    }
    fragments.forget_old(now + Duration::from_secs(1000));
    assert_eq!(fragments.bytes(), 0);
}

/// A message compressed as PNG: the input is used as a PNG file, and as a text to compress.
pub fn png(data: &[u8]) {
    const LIMIT: usize = 100_000;
    let text = base64_simd::STANDARD.encode_to_string(data);
    if let Ok(message) = decode_png(&text, LIMIT) {
        assert!(message.len() <= LIMIT);
    }
    if let Ok(text) = std::str::from_utf8(data) {
        let _ = decode_png(text, LIMIT);
        if let Ok(packed) = encode_png(data)
            && text.len() < LIMIT / 2
        {
            // PNG compression pads with these characters.
            let text = text.trim_end_matches(['\n', '\0']);
            let unpacked = decode_png(&packed, LIMIT).expect("its own picture");
            assert_eq!(unpacked, text);
        }
    }
}
