//! Serialized messages of one ROS carried to the other.

use std::sync::{Arc, LazyLock};

use ::ros::bus::RosVersion;
use ::ros::codec;
use ::ros::schema::Registry;
use ::translation::{MessageTwin, TranslationRules, TypeTranslations};

/// Pairs from which the first byte of the input selects one.
pub(crate) static PAIRS: LazyLock<Vec<Arc<MessageTwin>>> = LazyLock::new(|| {
    let registry = |version, definitions: &[(&str, &str)]| {
        let registry = Registry::for_version(version);
        for (key, text) in definitions {
            registry.insert(key, text).expect("these are definitions");
        }
        Arc::new(registry)
    };
    let one = registry(
        RosVersion::One,
        &[
            (
                "a/msg/All",
                "bool a\nint8 b\nuint16 c\nint32 d\nuint64 e\nfloat32 f\nfloat64 g\ntime h\nduration i\nbyte j\n\
                 bool[] k\nuint8[] l\nint16[2] m\nfloat64[] n\nstring[] o\ntime[] p\nNothing[] q\nPoint[] r\n\
                 Text[2] s\n",
            ),
            ("a/msg/Nothing", ""),
            ("a/msg/Point", "float64 x\nfloat64 y\n"),
            ("a/msg/Text", "uint8 n\nstring data\n"),
            ("a/msg/Way", "Header header\nPlace[] places\nint32[] indices\n"),
            ("a/msg/Place", "Header header\nPoint point\nstring name\n"),
            ("a/msg/Narrow", "int64 a\nint32[] b\nstring c\nfloat64 d\nstring[] e\nNothing[] f\nText g\n"),
        ],
    );
    // The same in another order, with bounds and other ranges.
    let known = registry(
        RosVersion::Two,
        &[
            (
                "a/msg/Narrow",
                "uint8 alone 7\nText g\nwstring c\nNothing[<=9] f\nint16[<=3] b\nfloat32 d\nuint8 a\nstring<=4[2] e\n",
            ),
            ("a/msg/Nothing", ""),
            ("a/msg/Text", "string<=8 data\nint64 n\nstring more 'text'\n"),
        ],
    );
    let two = registry(
        RosVersion::Two,
        &[
            (
                "a/msg/All",
                "wstring a\nstring<=4 b\nint64[<=2] c\nwstring[] d\nbuiltin_interfaces/Time e\nbyte f\n\
                 builtin_interfaces/Duration[] g\nNothing[3] h\nNothing[] i\nPoint[] j\nuint8 k\nfloat64 l\n",
            ),
            ("a/msg/Nothing", ""),
            ("a/msg/Point", "float64 x\nfloat64 y\n"),
            (
                "sensor_msgs/msg/Image",
                "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 \
                step\n\
                 uint8[] data\n",
            ),
        ],
    );
    let derived = TypeTranslations::new(TranslationRules::default());
    let given = TypeTranslations::new(TranslationRules::default()).with_known(known, RosVersion::Two);
    let pair = |registry: &Registry, translations: &TypeTranslations, name: &str| {
        translations.message(&registry.message(name).expect("it was inserted")).expect("it has a twin")
    };
    vec![
        pair(&one, &derived, "a/All"),
        pair(&one, &derived, "a/Way"),
        pair(&one, &given, "a/Narrow"),
        pair(&two, &derived, "a/All"),
        pair(&two, &derived, "sensor_msgs/Image"),
    ]
});

/// A message of a type, and of its twin.
pub fn bytes(data: &[u8]) {
    let Some((first, bytes)) = data.split_first() else {
        return;
    };
    let pair = &PAIRS[usize::from(*first) % PAIRS.len()];
    let ways = [
        (&pair.original, &pair.to_twin, &pair.twin, &pair.from_twin),
        (&pair.twin, &pair.from_twin, &pair.original, &pair.to_twin),
    ];
    for (source, there, target, back) in ways {
        let Ok(carried) = there.translate(bytes) else {
            continue;
        };
        codec::validate(source, bytes).expect("what was carried is a message");
        codec::validate(target, &carried).expect("what was written is a message");
        // Bounds of the source may refuse what was cut to fit; whatever comes back goes there again the same.
        if let Ok(returned) = back.translate(&carried) {
            codec::validate(source, &returned).expect("what came back is a message");
            let again = there.translate(&returned).expect("it holds nothing that was not carried before");
            assert_eq!(again.len(), carried.len(), "values that once fitted fit again");
        }
    }
}

/// A file of rules; a zero byte, then a definition of ROS 1 whose twin is found by them.
pub fn rules(data: &[u8]) {
    let mut parts = data.splitn(2, |byte| *byte == 0).map(String::from_utf8_lossy);
    let (yaml, definition) = (parts.next().unwrap_or_default(), parts.next().unwrap_or_default());
    let Ok(rules) = TranslationRules::default().with_yaml("rules.yaml", &yaml) else {
        return;
    };
    let registry = Registry::for_version(RosVersion::One);
    let _ = registry.insert_full_text("a/B", &definition);
    if let Ok(message) = registry.message("a/B") {
        if let Ok(pair) = TypeTranslations::new(rules).message(&message) {
            let bytes = codec::default_message(&message);
            let carried = pair.to_twin.translate(&bytes);
            if let Ok(carried) = carried {
                codec::validate(&pair.twin, &carried).expect("what was written is a message");
            }
        }
    }
}
