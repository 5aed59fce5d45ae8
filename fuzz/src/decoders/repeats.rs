//! Texts that take much memory for their size.

/// A text with a repeated part.
#[derive(Clone, Copy)]
pub struct Repeat {
    /// Text before the repeated part.
    pub before: &'static str,
    /// Repeated part.
    pub part: &'static str,
    /// Text after the repeated part.
    pub after: &'static str,
}

const fn repeat(before: &'static str, part: &'static str, after: &'static str) -> Repeat {
    Repeat { before, part, after }
}

impl Repeat {
    /// Returns the text, with as many repetitions as fit into `bytes` bytes.
    pub fn text(&self, bytes: usize) -> String {
        let mut text = self.before.to_owned();
        let mut count = 0;
        while text.len() + self.part.len() + self.after.len() < bytes {
            text.push_str(&self.part.replace("{n}", &format!("{count:x}")));
            count += 1;
        }
        text + self.after
    }
}

/// Fifty nested lists.
macro_rules! fifty {
    ("[") => {
        "[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[["
    };
    ("]") => {
        "]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]"
    };
}

/// Values in JSON between two texts.
macro_rules! values {
    ($before:expr, $after:expr) => {
        &[
            repeat(concat!($before, "["), "1,", concat!("1]", $after)),
            repeat(concat!($before, "["), "[],", concat!("[]]", $after)),
            repeat(concat!($before, "["), "[1],", concat!("[]]", $after)),
            repeat(concat!($before, "["), "{},", concat!("{}]", $after)),
            repeat(concat!($before, "["), "\"\",", concat!("1]", $after)),
            repeat(concat!($before, "["), "{\"\":1},", concat!("1]", $after)),
            repeat(concat!($before, "{"), "\"{n}\":1,", concat!("\"\":1}", $after)),
            repeat(concat!($before, "{"), "\"{n}\":[],", concat!("\"\":1}", $after)),
            repeat(concat!($before, "\""), "\\n", concat!("\"", $after)),
            repeat(concat!($before, fifty!("["), "["), "1,", concat!("1]", fifty!("]"), $after)),
            repeat(concat!($before, fifty!("["), "["), "{\"\":1},", concat!("1]", fifty!("]"), $after)),
        ]
    };
}

pub(super) const VALUES: &[Repeat] = values!("", "");
pub(super) const HELLO: &[Repeat] = values!("{\"parameters\":{\"a\":", "}}");
pub(super) const VIEWER: &[Repeat] =
    values!("{\"op\":\"setParameters\",\"parameters\":[{\"name\":\"a\",\"value\":", "}]}");
pub(super) const ORDERS: &[Repeat] = &[
    repeat("{\"requests\":[", "{},", "{}]}"),
    repeat("{\"decided\":[", "{},", "{}]}"),
    repeat("{\"refused\":[", "{},", "{}]}"),
    repeat("{\"dropped\":[", "{\"topic\":\"\",\"cause\":\"stale\",\"count\":1},", "]}"),
    repeat("{\"graph\":{\"outputs\":[", "{},", "{}]}}"),
    repeat("{\"graph\":{\"inputs\":[", "{},", "{}]}}"),
    repeat("{\"graph\":{\"services\":[", "{},", "{}]}}"),
    repeat("{\"graph\":{\"siblings\":[", "\"\",", "\"\"]}}"),
    repeat("{\"graph\":{\"nodes\":{", "\"{n}\":{},", "\"\":{}}}}"),
    repeat("{\"graph\":{\"nodes\":{\"\":{\"inputs\":[", "\"{n}\",", "\"\"]}}}}"),
    repeat("{\"parameters\":[", "[\"\",null],", "[\"\",null]]}"),
    repeat("{\"parameters\":[", "[\"\",{\"\":1}],", "[\"\",null]]}"),
    repeat("{\"parameters\":[[\"\",[", "{\"\":1},", "1]]]}"),
    repeat("{\"lent\":{\"service\":\"\",\"of\":{\"halves\":[", "\"\",", "\"\"]}}}"),
    repeat("{\"line\":{\"error\":false,\"text\":\"", "\\n", "\"}}"),
    repeat("{\"later\":[", "{},", "{}]}"),
];
pub(super) const ROSBRIDGE: &[Repeat] = &[
    repeat("{\"op\":\"publish\",\"topic\":\"/t\",\"msg\":[", "{},", "{}]}"),
    repeat("{\"op\":\"publish\",\"topic\":\"/t\",", "\"{n}\":1,", "\"msg\":{}}"),
    repeat("{\"op\":\"", "\\n", "\"}"),
    repeat("{\"op\":\"fragment\",\"id\":\"1\",\"num\":0,\"total\":2,\"data\":\"", "\\n", "\"}"),
];
pub(super) const XML_RPC: &[Repeat] = &[
    repeat(
        "<methodResponse><params><param><value><array><data>",
        "<value/>",
        "</data></array></value></param></params></methodResponse>",
    ),
    repeat(
        "<methodResponse><params><param><value><array><data>",
        "<value><struct><member><name/><value/></member></struct></value>",
        "</data></array></value></param></params></methodResponse>",
    ),
    repeat(
        "<methodResponse><params><param><value><struct>",
        "<member><name>{n}</name><value/></member>",
        "</struct></value></param></params></methodResponse>",
    ),
    repeat("<methodCall><methodName>x</methodName><params>", "<param><value/></param>", "</params></methodCall>"),
    repeat("<methodCall><methodName>", "&lt;", "</methodName></methodCall>"),
];
pub(super) const DEFINITIONS: &[Repeat] = &[
    repeat("", "a{n}\n", ""),
    repeat("", "bool a{n}\n", ""),
    repeat("", "int8 A{n}=1\n", ""),
    repeat("", "X{n} x{n}\n", ""),
    repeat("Y y\n", "===\nMSG: b/Y{n}\nint8 a\n", ""),
    repeat("", "#\n", ""),
];

pub(super) const SAVED: &[Repeat] = &[
    repeat("[{\"Config\":\"config.json\",\"Layers\":[", "\"\",", "\"\"]}]"),
    repeat("[", "{\"Config\":\"\",\"Layers\":[]},", "{\"Config\":\"\",\"Layers\":[]}]"),
    repeat("{\"manifests\":[{\"annotations\":{", "\"{n}\":\"\",", "\"\":\"\"}}]}"),
    repeat(
        "[{\"Config\":\"config.json\",\"Layers\":[]}]\0{\"rootfs\":{\"diff_ids\":[]},\"config\":{\"Env\":[",
        "\"\",",
        "\"\"]}}",
    ),
];

pub(super) const MANIFESTS: &[Repeat] = &[
    repeat("<package format=\"2\"><name>a</name>", "<depend>a{n}</depend>", "</package>"),
    repeat("<package><name>a</name>", "<a/>", "</package>"),
    repeat("<package><name>a</name><export ", "a{n}=\"\" ", "/></package>"),
    repeat("<package>", "<a>", ""),
    repeat("<package>", "<a xmlns:b{n}=\"u\">", ""),
    repeat("<package><name>a</name><description>", "&lt;", "</description></package>"),
    repeat("<package format=\"3\"><name>a</name><depend condition=\"a", " == a and a", "\">b</depend></package>"),
    repeat("<package format=\"3\"><name>a</name><depend condition=\"", "(", "\">b</depend></package>"),
];

pub(super) const INTERFACES: &[Repeat] = &[
    repeat("", "[[topics]]\n", ""),
    repeat("", "a{n}=1\n", ""),
    repeat("[[parameters]]\nname=\"/a\"\nvalue=[", "1,", "]\n"),
    repeat("[[parameters]]\nname=\"/a\"\nvalue=[", "{},", "]\n"),
    repeat("[[parameters]]\nname=\"/a\"\nvalue=", "[", ""),
    repeat("[[needs]]\nname=\"/a\"\nnodes=[", "\"/b\",", "]\n"),
];
