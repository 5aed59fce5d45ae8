use budget::Budget;
use ros::bus::SerializedMessage;

use super::*;

#[test]
fn a_topic_keeps_the_encodings_of_its_latest_messages_only() {
    let daemon = Budget::new("the daemon", 1 << 30);
    let options = BridgeOptions { budget: daemon.child("servant x", 64 << 20), ..BridgeOptions::default() };
    let metrics = Metrics::default();
    let types = Arc::new(TopicTypes::new(Arc::new(Registry::new())));
    let wire_type = Arc::new(WireType::with_name("a/B"));
    let topic: Arc<str> = "/t".into();
    let frame = |sample: &Arc<TopicSample>| sample.frame(Compression::CborRaw, &topic, &options, &metrics).unwrap();
    // As in the queue of a client that reads slowly.
    let waiting: Vec<_> = (0..40)
        .map(|_| {
            let message = SerializedMessage {
                bytes: vec![0; 1 << 20].into(),
                wire_type: wire_type.clone(),
                publisher: "/p".into(),
                latching: false,
            };
            let sample = TopicSample::new(message, false, types.clone(), &options).unwrap();
            let sample = Arc::new(sample);
            frame(&sample);
            sample
        })
        .collect();
    assert!(options.budget.used_bytes() <= WARM.1 + (1 << 20));
    assert!(daemon.used_bytes() <= (40 << 20) + WARM.1 + (1 << 20));
    assert_eq!(metrics.encoded.get(), 40);
    frame(&waiting[39]);
    assert_eq!(metrics.encoded.get(), 40, "it is still there");
    let late = frame(&waiting[0]);
    assert_eq!(metrics.encoded.get(), 41);
    drop(waiting);
    assert_eq!(options.budget.used_bytes(), 0);
    assert_eq!(daemon.used_bytes(), late.bytes.len(), "a client is being sent it");
    drop(late);
    assert_eq!(daemon.used_bytes(), 0);
}
