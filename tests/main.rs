//! End-to-end tests of the whole system, called stories: each covers a task of a user with real components. Run by
//! `make stories`, as root.

use std::process::ExitCode;
use std::time::Duration;

use ros::bus::RosVersion;
use support::Verdict;

use runner::RunnableStory;

#[path = "stories/access.rs"]
mod access;
#[path = "stories/acme.rs"]
mod acme;
#[path = "stories/answer.rs"]
mod answer;
#[path = "stories/audit.rs"]
mod audit;
#[path = "stories/borrowed.rs"]
mod borrowed;
#[path = "stories/bounds.rs"]
mod bounds;
#[path = "stories/breakin.rs"]
mod breakin;
#[path = "stories/browser.rs"]
mod browser;
#[path = "stories/burglary.rs"]
mod burglary;
#[path = "stories/calibration.rs"]
mod calibration;
#[path = "stories/calls.rs"]
mod calls;
#[path = "stories/candidates.rs"]
mod candidates;
#[path = "stories/clients.rs"]
mod clients;
#[path = "stories/clients_of_ros2.rs"]
mod clients_of_ros2;
#[path = "stories/commands.rs"]
mod commands;
#[path = "stories/cpp.rs"]
mod cpp;
#[path = "stories/cross.rs"]
mod cross;
#[path = "stories/crossing.rs"]
mod crossing;
#[path = "stories/cuts.rs"]
mod cuts;
#[path = "stories/described.rs"]
mod described;
#[path = "stories/eval.rs"]
mod eval;
#[path = "stories/exec.rs"]
mod exec;
#[path = "stories/failover.rs"]
mod failover;
#[path = "stories/fallback.rs"]
mod fallback;
#[path = "stories/farewells.rs"]
mod farewells;
#[path = "stories/goals.rs"]
mod goals;
#[path = "stories/grants.rs"]
mod grants;
#[path = "stories/history.rs"]
mod history;
#[path = "stories/house.rs"]
mod house;
#[path = "stories/hung.rs"]
mod hung;
#[path = "stories/images.rs"]
mod images;
#[path = "stories/inside.rs"]
mod inside;
#[path = "stories/isolation.rs"]
mod isolation;
#[path = "stories/launched.rs"]
mod launched;
#[path = "stories/lifecycle.rs"]
mod lifecycle;
#[path = "stories/link.rs"]
mod link;
#[path = "stories/memory.rs"]
mod memory;
#[path = "stories/metrics.rs"]
mod metrics;
#[path = "stories/mishaps.rs"]
mod mishaps;
#[path = "stories/mixed.rs"]
mod mixed;
#[path = "stories/names.rs"]
mod names;
#[path = "stories/oidc.rs"]
mod oidc;
#[path = "stories/operations.rs"]
mod operations;
#[path = "stories/other_ros.rs"]
mod other_ros;
#[path = "stories/page.rs"]
mod page;
#[path = "stories/pairing.rs"]
mod pairing;
#[path = "stories/patience.rs"]
mod patience;
#[path = "stories/people.rs"]
mod people;
#[path = "stories/portal.rs"]
mod portal;
#[path = "stories/privileges.rs"]
mod privileges;
#[path = "stories/push.rs"]
mod push;
#[path = "stories/queue.rs"]
mod queue;
#[path = "stories/quotas.rs"]
mod quotas;
#[path = "stories/readiness.rs"]
mod readiness;
#[path = "stories/recordings.rs"]
mod recordings;
#[path = "stories/refusals.rs"]
mod refusals;
#[path = "stories/registries.rs"]
mod registries;
mod rehearsal;
#[path = "stories/reported.rs"]
mod reported;
#[path = "stories/robot_network.rs"]
mod robot_network;
#[path = "stories/rollouts.rs"]
mod rollouts;
#[path = "stories/ros2.rs"]
mod ros2;
mod runner;
#[path = "stories/shadowing.rs"]
mod shadowing;
#[path = "stories/sharing.rs"]
mod sharing;
#[path = "stories/survival.rs"]
mod survival;
#[path = "stories/telling.rs"]
mod telling;
#[path = "stories/terms.rs"]
mod terms;
#[path = "stories/tls.rs"]
mod tls;
#[path = "stories/tokens.rs"]
mod tokens;
#[path = "stories/trying.rs"]
mod trying;
#[path = "stories/underlays.rs"]
mod underlays;
#[path = "stories/untrusted.rs"]
mod untrusted;
#[path = "stories/viewers.rs"]
mod viewers;
#[path = "stories/warm_pool.rs"]
mod warm_pool;

/// Creates a story with the name of its function.
fn story(name: &'static str, tell: fn() -> Verdict) -> RunnableStory {
    let tell = Box::new(tell);
    RunnableStory { name, tell }
}

/// Lists the stories of a module, each with its function's name.
macro_rules! stories {
    ($module:ident: $($name:ident),+ $(,)?) => {
        vec![$(story(concat!(stringify!($module), "::", stringify!($name)), $module::$name)),+]
    };
}

/// Lists the stories of a module for robots of ROS 1 and of ROS 2.
macro_rules! of_both {
    ($module:ident: $($name:ident),+ $(,)?) => {
        vec![$(
            story_for(RosVersion::One, concat!(stringify!($module), "::", stringify!($name)), $module::$name),
            story_for(RosVersion::Two, concat!(stringify!($module), "::ros2::", stringify!($name)), $module::$name),
        )+]
    };
}

/// Creates a story for robots of one version of ROS.
fn story_for(version: RosVersion, name: &'static str, tell: fn(RosVersion) -> Verdict) -> RunnableStory {
    let tell = Box::new(move || tell(version));
    RunnableStory { name, tell }
}

/// Stories that compare durations with each other; they run while no other story does.
const ALONE: [&str; 2] = [
    "calibration::fewer_cores_take_longer_and_rows_say_how_long",
    "page::a_hundred_servants_stay_fluid_and_an_hour_leaves_nothing",
];

/// Time after which a story counts as hanging; the longest story takes two minutes.
const LONGEST_STORY: Duration = Duration::from_secs(1200);

fn main() -> ExitCode {
    if std::env::var_os("CLOUDROID_STORIES").is_none() {
        println!("stories are told by make stories, with what they need");
        return ExitCode::SUCCESS;
    }
    if let Some(limit) = rehearsal::limit() {
        return runner::run(rehearsal::stories(), &[], limit);
    }
    // The programs of other architectures take minutes to build; make test-cross builds them and sets the variable.
    let built = std::env::var("CLOUDROID_CROSS").unwrap_or_default();
    let has = |architecture: &str| built.split_whitespace().any(|one| one == architecture);
    let mut cross = Vec::new();
    if has("aarch64") {
        cross.extend(stories![cross: an_aarch64_robot_works]);
    }
    if has("armv7") {
        cross.extend(stories![cross: an_armv7_robot_works]);
    }
    let stories: Vec<RunnableStory> = [
        cross,
        stories![answer: a_robot_finds_people_in_real_pictures, the_interface_is_found_lazy_inputs_included],
        stories![burglary:
            no_attempt_to_break_out_succeeds,
            nothing_of_the_host_is_reached,
            neighbours_are_not_reached,
        ],
        stories![borrowed:
            services_elsewhere_and_modules_of_plain_packages_are_found,
            all_that_a_package_forgot_is_named_at_once,
            a_python_module_that_a_package_forgot_is_named,
            a_package_whose_programs_are_not_found_is_refused_at_once,
            nodes_that_speak_zenoh_are_refused_before_a_build,
            what_to_run_is_asked_for_before_anything_is_compiled,
            a_dependency_is_met_by_a_package_of_another_name,
        ],
        stories![calibration:
            fewer_cores_take_longer_and_rows_say_how_long,
            what_cannot_be_calibrated_is_said,
            a_robots_own_requests_are_replayed_and_it_hears_none_of_the_answers,
            a_calibration_that_nobody_waits_for_leaves_nothing,
            a_calibration_gives_way_to_a_robot,
        ],
        stories![calls: a_cpp_node_waits_for_the_robot_and_calls_it],
        of_both![calls:
            a_python_node_calls_the_robot,
            a_call_of_the_robot_outlives_a_cut_and_fails_with_the_link,
            siblings_come_first_and_other_robots_are_not_asked,
        ],
        stories![commands:
            a_script_can_tell_by_the_exit_status_what_to_do,
            a_servant_is_named_by_its_service_where_that_has_no_other,
            who_follows_events_misses_none_when_the_daemon_is_started_again,
            shells_complete_it_and_every_verb_has_a_page,
            top_shows_who_uses_the_machine,
        ],
        stories![cpp:
            a_node_over_rcl_answers_with_types_of_its_workspace,
            a_library_that_a_parameter_names_is_loaded,
            a_lifecycle_node_over_rcl_becomes_active,
        ],
        stories![described: every_answer_is_as_the_document_says],
        stories![history: what_servants_did_outlives_them_and_the_daemon],
        stories![metrics:
            every_metric_is_listed_and_read_by_others,
            the_dashboard_asks_for_what_there_is,
        ],
        stories![oidc:
            a_group_of_the_provider_is_a_role_here,
            who_has_no_role_is_told_why,
            a_token_that_is_not_good_signs_nobody_in,
            a_sign_in_is_good_once_and_in_its_browser,
            a_provider_that_is_down_keeps_nobody_else_out,
            sessions_end_when_the_configuration_gives_other_rights,
            a_real_browser_comes_back_signed_in,
            through_tls_both_cookies_are_this_hosts_alone,
        ],
        stories![people:
            people_sign_in_and_out,
            whoever_cannot_sign_in_is_told_no_more_than_that,
            who_guesses_passwords_is_slowed,
            other_sites_pages_do_nothing_in_a_persons_browser,
            through_tls_the_cookie_is_shown_through_tls_alone,
        ],
        stories![eval:
            a_package_is_evaluated_native_against_outsourced,
            what_cannot_be_evaluated_is_said,
        ],
        of_both![exec: a_program_runs_as_the_servants_nodes_do],
        stories![exec:
            a_shell_at_a_terminal_has_one,
            who_may_not_is_refused_and_who_may_no_longer_is_ended,
            a_program_ends_with_a_daemon_that_is_killed,
        ],
        of_both![failover:
            a_slow_network_costs_few_requests,
            a_lost_link_hands_over_and_back,
            frames_that_stay_away_stop_the_robot_and_wake_its_original,
            outputs_that_become_too_old_wake_the_original,
            a_first_sign_has_the_original_ready_before_it_is_needed,
            a_camera_faster_than_its_node_stops_nobody,
            explain_says_why,
        ],
        of_both![fallback:
            an_untouched_stub_finds_its_way_when_the_cable_is_cut_and_hands_back,
            a_server_that_was_never_reached_is_stood_in_for_until_it_comes,
            a_promise_holds_without_a_server_too_until_it_comes,
            a_blip_of_the_link_starts_nothing_and_loses_nothing,
            an_untouched_stub_can_be_told_to_leave_the_original_alone,
        ],
        stories![grants:
            a_service_is_given_what_its_operator_allows,
            nothing_is_given_unasked_or_unallowed,
        ],
        stories![clients:
            the_first_five_minutes_of_the_readme_end_well,
            roslibpy_finds_nothing_missing,
            roslib_finds_nothing_missing,
            roslibrust_finds_nothing_missing,
            clients_with_tokens_find_nothing_missing,
            what_a_node_that_is_well_prints_is_in_its_log_at_once,
        ],
        stories![clients_of_ros2: they_find_nothing_missing],
        stories![house:
            a_second_daemon_on_the_same_home_is_refused,
            the_state_is_closed_to_others,
            a_taken_port_is_named,
            doctor_names_each_need,
            a_robot_that_stays_away_loses_its_servant_after_the_grace_time,
        ],
        of_both![house: the_demo_ends_by_itself_and_leaves_nothing],
        stories![images:
            skopeo_and_umoci_read_the_store,
            an_exported_service_is_published_on_another_server,
            a_base_is_moved_to_a_server_without_network,
            a_saved_image_becomes_a_base,
            an_image_of_a_registry_becomes_a_base,
            a_root_file_system_made_by_hand_becomes_a_base,
            what_nobody_refers_to_is_collected,
        ],
        stories![underlays:
            a_node_is_compiled_and_runs_upon_a_compiled_workspace,
            an_underlay_of_ros_2_has_interfaces_and_modules,
        ],
        stories![registries: skopeo_and_containerd_pull_with_a_token],
        stories![inside:
            a_viewer_hears_and_does_nothing_and_an_operator_acts,
            looking_inside_keeps_no_servant_and_is_bounded,
            who_looks_slowly_costs_its_robot_nothing,
            what_is_published_is_counted_and_goals_are_remembered,
        ],
        stories![recordings:
            a_recording_holds_what_a_robot_heard_and_is_replayed,
            what_cannot_be_recorded_or_replayed_is_said,
            a_black_box_is_written_when_a_robot_waits_too_long,
        ],
        stories![viewers:
            foxgloves_client_hears_and_an_operators_acts,
            viewers_that_ask_badly_are_told_and_cost_nothing,
        ],
        stories![isolation:
            every_node_process_is_confined,
            nothing_of_ours_but_init_runs_inside,
            limits_are_set_and_read_back,
            limits_are_changed_while_it_works,
            a_node_that_takes_too_much_memory_is_killed_and_its_robot_told,
            two_robots_see_nothing_of_each_other,
        ],
        stories![quotas:
            what_a_servant_may_not_write_is_refused_to_it_alone,
            a_node_that_shouts_costs_no_disk,
        ],
        stories![privileges:
            threads_that_read_what_strangers_send_have_no_rights,
            the_portals_user_is_who_the_configuration_says,
        ],
        stories![terms:
            a_robot_is_given_what_its_sla_costs,
            a_robot_that_says_nothing_of_its_pictures_pays_for_those_that_it_sends,
        ],
        of_both![terms:
            a_stub_states_what_its_robot_says_before_it_is_admitted,
            what_a_stub_passes_on_is_measured_as_well,
        ],
        stories![launched:
            roslaunch_cannot_tell_the_stub_from_the_original,
            rosrun_gives_the_node_the_name_that_the_original_has,
            a_launch_file_says_what_is_promised,
        ],
        of_both![mixed:
            stamps_transforms_and_calls_cross,
            an_action_is_carried_out_in_the_other_ros,
            a_node_calls_a_robot_of_the_other_ros,
            a_node_sends_goals_to_a_robot_of_the_other_ros,
            simulated_time_is_the_robots,
            parameters_of_the_node_are_the_robots,
            the_robots_own_original_answers_while_the_cable_is_cut,
        ],
        stories![mixed:
            a_node_of_ros_2_is_reconfigured_by_a_robot_of_ros_1,
            a_node_of_ros_1_is_reconfigured_by_a_robot_of_ros_2,
        ],
        of_both![crossing:
            stamps_mean_the_same_where_clocks_differ,
            simulated_time_is_the_robot_s,
            transforms_of_all_publishers_arrive,
            explain_names_a_clock_and_a_queue,
        ],
        of_both![goals:
            an_action_is_carried_out_in_the_cloud,
            an_action_is_carried_out_by_the_original_while_the_cloud_is_slow,
            a_goal_is_carried_out_once_however_often_the_link_is_cut,
        ],
        stories![crossing:
            settings_are_changed_through_dynamic_reconfigure,
            pictures_are_made_smaller_where_the_link_is_slow,
        ],
        stories![pairing:
            a_robot_is_paired_by_a_line_and_gone_at_a_word,
            certificates_renew_themselves_and_end_while_the_robot_is_off,
            what_cannot_be_paired_is_said,
            a_labs_own_authority_speaks_for_its_robots,
            a_stub_is_installed_and_paired_by_one_line,
        ],
        of_both![farewells: a_stub_ends_beside_a_daemon_that_is_frozen_or_killed],
        stories![patience:
            a_node_that_waits_is_seen_whole_and_driven_by_its_robot,
            a_goal_is_reached_by_the_original_when_the_cable_is_cut_on_the_way,
        ],
        of_both![cuts: no_request_is_lost_or_answered_twice_however_often_the_link_is_cut],
        stories![link:
            a_greeter_in_the_cloud_is_a_node_of_the_robot,
            the_robot_s_graph_is_the_original_s,
            a_lost_link_is_taken_up_again,
            the_robot_s_master_starts_again,
        ],
        of_both![link:
            two_nodes_share_a_servant,
            what_a_stub_cannot_do_is_said,
            a_connection_that_falls_silent_is_replaced,
            one_message_right_after_connecting_is_not_lost,
            who_has_just_connected_hears_what_the_node_answers,
        ],
        stories![ros2:
            a_workspace_is_pushed_and_asked_by_rosbridge,
            a_workspace_runs_on_kilted_as_on_jazzy,
            a_prebuilt_space_is_served_with_its_interfaces,
            two_programs_of_several_nodes_have_nodes_of_their_own_names,
            nodes_stay_in_the_namespaces_that_their_programs_give_them,
            a_herald_in_the_cloud_is_a_node_of_the_robot,
            the_robot_s_graph_is_the_original_s,
            an_application_of_rclpy_asks_the_cloud,
            a_node_lives_on_when_the_daemon_starts_again,
            pictures_are_made_smaller_where_the_link_is_slow,
        ],
        stories![lifecycle: nodes_of_a_servant_become_active_and_share_their_memory],
        stories![robot_network:
            another_machine_finds_a_stub_by_multicast,
            another_machine_finds_a_stub_by_a_server_that_comes_later_and_again,
            another_machine_with_cyclone_dds_finds_a_stub,
        ],
        stories![memory:
            what_is_begun_and_never_ended_costs_its_owner,
        ],
        stories![hung: a_node_that_answers_no_more_is_told_and_started_again],
        stories![mishaps:
            another_version_of_the_protocol_is_named,
            parameters_that_cannot_be_carried_are_named_and_the_others_arrive,
            a_local_original_that_crashes_is_told_and_started_again,
        ],
        of_both![mishaps:
            a_later_revision_is_gone_on_with_unless_its_interface_differs,
            a_wrong_token_is_named,
            two_robots_with_one_id_are_told,
            a_missing_original_is_said_once_and_the_cloud_goes_on,
            an_original_that_crashes_is_told_and_started_again,
            a_service_that_is_gone_leaves_the_local_original,
        ],
        stories![breakin:
            nobody_gets_beyond_its_role_and_scope,
            nothing_is_smuggled_past_who_asks,
            another_account_of_this_machine_reaches_nothing,
            a_neighbour_gets_no_further_than_the_door,
            a_page_of_another_site_reaches_nothing_in_a_real_browser,
        ],
        stories![browser: a_page_with_roslib_shows_its_token],
        stories![page:
            it_shows_what_happens_and_does_what_one_may,
            a_canary_is_begun_promoted_and_taken_back,
            a_robot_is_paired_from_the_page,
            what_response_times_cost_is_measured_from_the_page,
            it_is_told_at_once_that_a_token_was_revoked,
            what_flows_inside_a_servant_is_drawn_and_changed,
            a_servant_of_ros_2_is_looked_into,
            settings_of_a_node_are_changed_inside,
            a_hundred_servants_stay_fluid_and_an_hour_leaves_nothing,
        ],
        stories![operations:
            every_operation_is_done_where_the_table_says,
            without_a_good_token_no_operation_is_heard
        ],
        stories![access:
            every_route_answers_those_whom_the_table_allows,
            what_is_asked_badly_is_refused_in_words,
            a_deployer_changes_its_own_services_alone,
            what_robots_may_changes_while_they_are_connected,
            what_was_begun_with_a_token_ends_with_it,
            this_machines_users_see_and_are_robots_and_change_nothing,
            robots_of_this_machine_stay_where_that_is_allowed,
        ],
        stories![audit:
            who_did_what_is_recorded_and_told_as_it_comes,
            no_secret_is_in_any_log,
            members_of_a_group_are_admins_at_a_socket_of_theirs,
            whoever_guesses_is_slowed_and_counted,
            who_was_refused_a_robots_name_and_for_whom_a_proxy_asked_is_recorded,
        ],
        stories![tokens:
            no_route_answers_without_a_token,
            whoever_lacks_a_token_is_told_how_to_give_one,
            a_proxy_s_clients_are_told_from_this_machine_s,
            a_page_of_another_site_uses_nobodys_browser,
            services_are_told_to_those_who_have_shown_a_token,
            a_resume_token_is_no_way_into_another_s_servant,
        ],
        stories![portal:
            topics_and_services_cross_both_ways,
            cbor_is_spoken_too,
            a_robot_serves_and_a_node_side_caller_is_answered,
            bad_frames_are_answered_by_status,
            a_frame_over_the_limit_closes_with_1009,
            unknown_services_are_404_and_name_what_exists,
            beyond_loopback_only_with_a_token,
            health_and_metrics_are_told,
            a_slash_behind_a_service_leads_to_the_same_service,
            a_handshake_that_cannot_be_taken_is_refused_by_what_is_wrong,
        ],
        of_both![reported:
            clients_that_subscribe_and_leave_at_once_leave_nothing,
            clients_that_come_at_once_are_all_answered,
            a_package_that_nobody_has_is_told_to_who_names_it_alone,
            json_in_binary_frames_is_read_as_it_comes,
        ],
        stories![bounds:
            a_build_that_takes_too_much_is_ended_and_leaves_nothing,
            a_push_outlives_its_client,
            what_a_push_lacks_is_told_before_it_waits_for_others,
            a_push_ends_with_what_its_deployer_showed,
            a_push_nobody_waits_for_ends_with_its_daemon,
            a_second_signal_ends_the_daemon_at_once,
            a_probe_waits_for_room_like_any_servant,
        ],
        stories![push:
            a_cpp_package_is_compiled_and_greets,
            which_output_answers_which_input_is_found_or_said,
            a_python_package_adds,
            a_launch_file_is_resolved_by_roslaunch,
            a_workspace_is_built_in_order,
            a_prebuilt_space_is_served,
            what_was_compiled_before_a_failure_stays_compiled,
            what_a_cancelled_push_has_compiled_stays_compiled,
            mistakes_in_cmake_are_told_before_anything_is_compiled,
            a_package_may_use_others_that_it_does_not_name,
            packages_with_the_same_libraries_share_their_layers,
            an_unchanged_push_builds_no_layer_and_makes_no_revision,
            a_failed_build_leaves_the_earlier_revision_serving,
            what_package_xml_forgot_is_named_and_added,
            what_is_packed_follows_links_and_leaves_out_what_is_ignored,
            a_revision_is_rolled_back,
            five_packaged_nodes_answer,
        ],
        stories![queue:
            who_finds_no_room_is_told_its_place_and_then_why_it_is_refused,
            robots_of_a_higher_class_go_first,
            a_probe_gives_way_to_a_robot,
        ],
        stories![readiness:
            a_node_that_is_slow_is_waited_for_until_its_interface_is_there,
            who_leaves_while_its_servant_starts_is_let_go_at_once,
        ],
        stories![refusals:
            a_directory_without_a_package,
            malformed_xml,
            dependencies_that_nothing_provides_are_listed_at_once,
            a_node_that_leaves_at_once,
            archives_that_reach_out_of_their_tree,
            reserved_and_taken_names,
            a_full_disk_ends_a_push_and_nothing_else,
            an_import_of_a_base_leaves_space_on_the_disk,
        ],
        stories![candidates:
            a_candidate_that_adds_otherwise_is_told_and_its_robot_hears_none_of_it,
            what_a_robot_says_is_said_to_a_candidate_too,
            calls_and_goals_are_carried_out_by_a_candidate_too,
            a_shared_service_is_compared_at_one_robots_calls_and_goals,
            a_candidate_gives_way_to_a_robot_and_what_was_compared_is_told,
            a_stubs_node_is_started_in_a_candidate_as_it_is_on_its_robot,
        ],
        stories![rollouts:
            a_canary_that_fails_is_taken_back_and_its_robot_goes_on,
            a_canary_is_promoted_and_robots_keep_what_they_have_until_the_deadline,
        ],
        stories![warm_pool:
            a_robot_takes_a_servant_whose_nodes_run,
            a_service_that_fails_again_and_again_says_when_it_is_tried,
            a_robot_takes_the_container_made_ahead_and_another_is_made,
            a_killed_daemons_warm_pool_end_without_a_word,
        ],
        stories![untrusted:
            who_dribbles_an_upgrade_is_let_go,
            connections_that_say_nothing_keep_nobody_out,
            rubbish_instead_of_an_upgrade_is_refused,
            two_sockets_of_one_robot_share_its_servant,
            nobody_takes_over_anothers_robot,
            an_answer_waits_for_one_big_message_at_most,
        ],
        stories![sharing:
            a_shared_service_grows_under_load_and_shrinks_after_it,
            an_application_of_rclpy_shares_one_servant_with_another_robot,
        ],
        of_both![sharing:
            twenty_robots_share_two_servants_and_one_of_these_is_killed,
            goals_of_robots_do_not_meet,
            what_robots_cannot_share_is_refused_with_what_was_found,
            of_two_replicas_the_first_answers_and_the_cost_is_shown,
            stubs_of_three_robots_use_two_servants_and_one_of_these_is_killed,
        ],
        stories![survival:
            what_cannot_be_removed_keeps_no_daemon_down,
            a_killed_daemon_loses_nothing,
            a_daemon_killed_while_a_servant_is_made_gives_it_all_that_it_is_granted,
            a_daemon_that_is_ended_says_why_and_keeps_its_servants,
            a_killed_init_and_a_killed_shim_are_told,
            nodes_end_as_ros_users_know_it,
            a_locked_database_is_named_and_waited_for,
            a_full_disk_is_named_and_robots_at_work_stay,
            what_a_full_disk_refuses_is_not_done,
        ],
        stories![acme:
            a_certificate_is_asked_for_and_renewed,
            who_comes_for_something_else_is_answered_no_challenge,
            what_cannot_be_asked_for_is_said_at_the_start,
            what_it_is_tested_with_ends_with_who_started_it,
        ],
        stories![tls:
            a_robot_works_through_tls,
            what_stands_against_tls_is_said,
            beyond_loopback_nothing_is_answered_in_plain_text,
            robots_of_all_kinds_come_through_the_daemons_tls,
            a_certificate_is_remembered_and_no_other_is_taken_for_it,
            a_certificate_is_read_again_when_it_changes,
            clients_of_a_named_proxy_are_told_apart,
        ],
        stories![telling:
            one_that_fails_once_is_told_again_and_its_world_is_kept,
            evidence_is_cut_in_the_middle_and_the_oldest_goes_first,
            more_than_two_by_chance_fail_the_run_and_strictly_the_first,
            one_without_an_end_is_named_and_ends_the_run,
            what_the_machine_lacks_is_said_in_a_line,
            what_a_killed_run_left_is_removed_by_the_next_and_a_living_one_is_left_alone,
        ],
        stories![trying:
            a_packaged_node_is_tried_on_a_picture,
            a_source_package_is_tried_on_a_recording,
            a_robot_is_explained,
        ],
        stories![names:
            a_server_is_found_in_the_hosts_file_and_by_dns,
            a_server_is_found_by_multicast_dns,
        ],
        stories![other_ros:
            a_robot_of_ros_2_starts_a_node_of_ros_1_as_its_own,
            a_robot_of_ros_1_starts_a_node_of_ros_2_as_its_own,
            tools_of_ros_1_find_the_stub_of_a_service_of_ros_2,
            rules_of_a_lab_name_the_types_of_its_robots,
            the_same_service_has_an_archive_for_either_ros,
        ],
        stories![shadowing:
            on_debians_layout_every_tool_finds_the_stub,
            on_an_opt_ros_layout_every_tool_finds_the_stub,
            on_an_opt_ros_layout_without_the_original_the_stub_stands_alone,
            without_the_original_the_stub_stands_alone,
            what_is_not_outsourced_becomes_the_original,
            the_installer_checks_before_it_writes_and_undoes_itself,
            where_the_other_ros_is_set_up_a_stub_is_refused,
            where_nodes_speak_zenoh_a_stub_is_refused,
            a_stub_that_was_changed_on_its_way_is_not_installed,
            its_nodelets_cannot_be_loaded_on_the_robot,
            stubs_are_served_to_those_who_may_and_say_what_is_lacking,
        ],
    ]
    .into_iter()
    .flatten()
    .collect();
    runner::run(stories, &ALONE, LONGEST_STORY)
}
