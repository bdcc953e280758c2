#!/bin/sh
# Plays learner, actor and evaluator in tests of the supervisor. RUN/fake/NAME has its mode.
# Appends its process id to RUN/fake/pids, and its starts and received commands to
# RUN/fake/NAME.seen.
trap '' INT TERM HUP
role=$1
shift
while [ $# -gt 0 ]; do
    case $1 in
    --run) run=$2 ;;
    --index) index=$2 ;;
    --incarnation) incarnation=$2 ;;
    --one-process) one=1 ;;
    --resume) resumed=" resumed" ;;
    esac
    shift
done
name=$role${index:+-$index}
fake=$run/fake
echo $$ >>"$fake/pids"
echo "started${incarnation:+ $incarnation}$resumed" >>"$fake/$name.seen"
mode=normal
[ -f "$fake/$name" ] && read -r mode <"$fake/$name"

ready() {
    echo '{"environment_ready":{"spec":{"id":"Fake-v0","observation_len":2,"action_len":1,"action_low":[-1.0],"action_high":[1.0],"control_dt_s":0.02,"episode_steps":50}}}'
}
progress() {
    echo '{"progress":{"env_steps":'"$1"',"updates":'"$1"',"segments":2,"env_steps_per_s":10.0,"updates_per_s":4.0,"return_mean":null,"samples_per_insert":1.0,"policy_lag_p50":0,"policy_lag_max":0,"queued_segments":0,"restarts":0,"rejected":0,"env_failures":0}}'
}
row() {
    echo '{"evaluated":{"env_steps":10,"updates":10,"segments":2,"wall_s":1.0,"policy_version":'"$1"',"returns":[-2.0,-4.0],"return_mean":-3.0,"success_rate":0.5,"smoothness":0.1}}'
}
evaluate() {
    echo '{"evaluate":{"env_steps":10,"updates":10,"segments":2,"wall_s":1.0,"policy_version":'"$1"'}}'
}
# Sends heartbeats in the background until the process exits.
beat() {
    (while kill -0 $$ 2>/dev/null; do echo '{"alive":{"doing":"stepping","kept":0}}'; sleep 0.1; done) &
}
sent() {
    echo '{"sent":{"produced":1,"sent":1,"resent":0,"acked":0}}'
}
starts() {
    grep -c started "$fake/$name.seen"
}
# Returns 0 on stop or finish, and 1 at the end of input.
until_stop() {
    while read -r line; do
        echo "$line" >>"$fake/$name.seen"
        case $line in '"stop"' | '"finish"') return 0 ;; esac
    done
    return 1
}
finish() {
    echo '{"checkpoint":{"name":"001","env_steps":10}}'
    echo '"finished"'
    exit 0
}

case $role-$mode in
*-silent) until_stop; exit 0 ;;
*-stubborn)
    # Reports that it is ready, then ignores everything but the end of input.
    [ "$role" = learner ] && echo '"learner_ready"' || ready
    while read -r line; do :; done
    ;;
actor-normal) ready; until_stop; exit 0 ;;
actor-noisy) echo 'hello from print()'; ready; until_stop; exit 0 ;;
actor-failing)
    ready
    for count in 1 1 1 2; do
        echo '{"env_failures":{"count":'"$count"',"last":"the gripper fell off"}}'
    done
    until_stop
    exit 0
    ;;
actor-refused) echo 'error: no environment Fake-v0' >&2; exit 1 ;;
actor-dies) ready; echo 'error: out of luck' >&2; exit 3 ;;
actor-beating) ready; beat; until_stop; exit 0 ;;
actor-freezes-once)
    ready
    [ "$incarnation" = 0 ] || beat
    echo '{"alive":{"doing":"waiting","kept":7}}'
    until_stop
    exit 0
    ;;
actor-dies-after-work) ready; sent; sleep 1.5; sent; kill -9 $$ ;;
actor-dies-before-work) ready; sent; kill -9 $$ ;;
actor-dies-once)
    ready
    [ "$incarnation" = 0 ] && kill -9 $$
    until_stop
    ;;
learner-normal)
    [ -n "$one" ] && ready
    echo '"learner_ready"'
    echo '"first_segment"'
    progress 10
    if [ -n "$one" ]; then row 1; else evaluate 1; evaluate 2; fi
    finish
    ;;
learner-until-stopped)
    echo '"learner_ready"'
    progress 10
    evaluate 1
    until_stop && finish
    echo saved >"$fake/orphaned"
    ;;
learner-until-five-failures)
    echo '"learner_ready"'
    while read -r line; do
        case $line in *'"total":5'*) finish ;; esac
    done
    ;;
learner-dies)
    echo '"learner_ready"'
    line=1
    while [ $line -le 20 ]; do echo "log line $line" >&2; line=$((line + 1)); done
    kill -9 $$
    ;;
learner-dies-once)
    # The first start dies during an evaluation.
    echo '"learner_ready"'
    progress 10
    if [ "$(grep -c started "$fake/$name.seen")" = 1 ]; then
        evaluate 1
        while ! grep -q 'policy_version":1' "$fake/evaluator.seen"; do :; done
        kill -9 $$
    fi
    echo '"first_segment"'
    evaluate 2
    finish
    ;;
learner-dies-after-work)
    # Writes a checkpoint and runs for a while before each death; finishes at the fourth start.
    echo '"learner_ready"'
    [ "$(starts)" = 4 ] && finish
    echo '{"checkpoint":{"name":"001","env_steps":10}}'
    sleep 0.3
    kill -9 $$
    ;;
learner-dies-after-a-checkpoint)
    echo '"learner_ready"'
    echo '{"checkpoint":{"name":"001","env_steps":10}}'
    kill -9 $$
    ;;
learner-after-four-starts)
    echo '"learner_ready"'
    while ! grep -q 'started 3' "$fake/actor-0.seen"; do :; done
    finish
    ;;
learner-refuses) echo 'error: no such checkpoint' >&2; exit 1 ;;
learner-asks-for-the-lock)
    echo '"learner_ready"'
    flock --nonblock "$run/lock" true || echo locked >>"$fake/$name.seen"
    finish
    ;;
learner-after-restarts)
    # Finishes when worker 0 has been restarted.
    echo '"learner_ready"'
    while ! grep -q 'started 1' "$fake/actor-0.seen"; do :; done
    finish
    ;;
evaluator-*)
    ready
    while read -r line; do
        echo "$line" >>"$fake/$name.seen"
        [ "$line" = '"stop"' ] && exit 0
        if [ "$mode" = dies-once ] && [ "$(grep -c started "$fake/$name.seen")" = 1 ]; then
            kill -9 $$
        fi
        [ "$mode" = dies ] && exit 4
        if [ "$mode" = slow-once ] && [ "$(grep -c started "$fake/$name.seen")" = 1 ]; then
            while read -r line; do :; done
        fi
        version=${line##*policy_version\":}
        version=${version%%\}*}
        if [ "$mode" = fails-once ] && [ "$version" = 1 ]; then
            echo '{"not_evaluated":{"policy_version":1,"reason":"its episode failed twice"}}'
        else
            row "$version"
        fi
    done
    ;;
esac
