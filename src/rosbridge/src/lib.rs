//! rosbridge
