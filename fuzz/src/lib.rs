//! One function per kind of untrusted input. Each reads or refuses its input and then checks properties of what was
//! read; a wrong result is a panic, as a crash would be.
//!
//! The fuzzer calls the functions through `fuzz_targets/` (`make fuzz ONLY=ros_json`), the tests through
//! `tests/replay.rs`, with the stored corpus and modifications of it. A new target needs a function here, an entry in
//! [`TARGETS`], a program in `fuzz_targets/` with its `[[bin]]`, and a few seeds in `corpus/`; if it reads untrusted
//! bytes, also an entry in [`DECODERS`](decoders::DECODERS), whose memory `tests/memory.rs` measures.

#![forbid(unsafe_code)]

pub mod authority;
pub mod codec;
pub mod damage;
pub mod decoders;
pub mod image;
pub mod link;
pub mod package;
pub mod ros;
pub mod ros2;
pub mod rosbridge;
pub mod rtps;
pub mod sign;
pub mod translation;
pub mod viewer;
pub mod ws;

/// Function that takes the fuzzer's bytes.
pub type Target = fn(&[u8]);

/// Every target, by the name of its program and of its directory in `corpus/`.
pub const TARGETS: &[(&str, Target)] = &[
    ("authority_request", authority::request),
    ("authority_certificate", authority::certificate),
    ("codec_zlib", codec::zlib),
    ("codec_deflate", codec::deflate),
    ("codec_zstd", codec::zstd),
    ("codec_image", codec::image),
    ("codec_grid", codec::grid),
    ("codec_scan", codec::scan),
    ("codec_cloud", codec::cloud),
    ("codec_video", codec::video),
    ("codec_jpeg", codec::jpeg),
    ("codec_frame", codec::frame),
    ("codec_message", codec::message),
    ("rosbridge_json", rosbridge::json),
    ("rosbridge_cbor", rosbridge::cbor),
    ("rosbridge_fragments", rosbridge::fragments),
    ("rosbridge_png", rosbridge::png),
    ("ros_json", ros::json),
    ("ros_cbor", ros::cbor),
    ("ros_bytes", ros::bytes),
    ("ros_definition", ros::definition),
    ("ros2_json", ros2::json),
    ("ros2_cbor", ros2::cbor),
    ("ros2_bytes", ros2::bytes),
    ("ros2_definition", ros2::definition),
    ("rtps_datagram", rtps::datagram),
    ("rtps_discovery", rtps::discovery),
    ("ros_tcpros", ros::tcpros),
    ("ros_xmlrpc", ros::xmlrpc),
    ("ros_parameter", ros::parameter),
    ("link_frame", link::frame),
    ("link_hello", link::hello),
    ("link_orders", link::orders),
    ("ws_frames", ws::frames),
    ("viewer_json", viewer::json),
    ("translation_bytes", translation::bytes),
    ("translation_rules", translation::rules),
    ("ros_bag", ros::bag),
    ("image_archive", image::archive),
    ("image_saved", image::saved_image),
    ("package_manifest", package::manifest),
    ("package_interface", package::interface),
    ("sign_signature", sign::signature),
];

/// Defines the program of a target: `fuzz::target!(ros, json);`. Outside of a fuzzing build the program does nothing.
#[macro_export]
macro_rules! target {
    ($module:ident, $function:ident) => {
        #[cfg(fuzzing)]
        libfuzzer_sys::fuzz_target!(|data: &[u8]| $crate::$module::$function(data));

        #[cfg(not(fuzzing))]
        fn main() {
            eprintln!("this is a fuzzer's program; run it by make fuzz");
        }
    };
}
