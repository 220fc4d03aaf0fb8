#!/usr/bin/env bash
# From a robot to a better model of it.
#
# A fake Go2 has a hidden Coulomb friction of 0.8 N·m at its left front calf. It walks twice with a trained policy, through the
# endpoint that an agent uses, in front of a motion capture. The first recording is diagnosed, the model that follows is compared with
# the ideal one on the second recording, and the policy walks in a simulation of that model.
#
# usage: examples/robot_to_model.sh FOLDER
#
# From the root of the repository, after `cargo build --release`. FOLDER must not exist. Then it has the two recordings,
# `diagnosis/report.html` and `diagnosis/extended.toml`.
set -euo pipefail

folder=${1:?usage: examples/robot_to_model.sh FOLDER}
twinstep=${TWINSTEP:-target/release/twinstep}
policy=data/policies/walk.safetensors
domain=$((10 + $$ % 200))
mkdir "$folder"

printf 'robot = "go2"\n' >"$folder/nominal.toml"
printf 'robot = "go2"\n[[effect]]\nname = "coulomb_friction"\nscope = "FL_calf"\ntorque_nm = 0.8\n' >"$folder/hidden.toml"
# A desktop computer may stand still for longer than a robot may wait for its states.
printf '[safety]\nstate_timeout_ms = 150\n' >"$folder/robot.toml"

# Whatever ends the script, no robot is left running.
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT

# Waits up to a minute for a line of `twinstep robot` that begins with $1. After a fault it does not come.
await() {
    local line end=$((SECONDS + 60))
    while ((SECONDS < end)) && read -r -t 60 line <&"${ROBOT[0]}"; do
        [[ $line == "$1"* ]] && return
    done
    echo "the robot did not say \`$1\`" >&2
    return 1
}

# Types the request $1 of the operator until it is executed, up to a minute.
request() {
    local line=error end=$((SECONDS + 60))
    until [[ $line == ok* ]]; do
        if ((SECONDS > end)); then
            echo "the robot did not execute \`$1\`: $line" >&2
            return 1
        fi
        sleep 0.1
        echo "$1" >&"${ROBOT[1]}"
        while read -r -t 60 line <&"${ROBOT[0]}" && [[ $line == state* ]]; do :; done
    done
}

# Walks with the velocity $1, and records it as $2.
walk() {
    echo "walks with $1, recorded as $2"
    "$twinstep" fake-robot --released --motion-capture --domain "$domain" --model "$folder/hidden.toml" >"$folder/fake.log" &
    local fake=$!
    coproc ROBOT {
        exec "$twinstep" robot --interface 127.0.0.1 --domain "$domain" --listen tcp/127.0.0.1:0 \
            --config "$folder/robot.toml" --record "$2"
    }
    local robot=$ROBOT_PID endpoint result=0
    read -r _ endpoint <&"${ROBOT[0]}"
    await "state observe"
    request release
    request arm
    request stand
    await "state ready"
    # After a fault, the robot waits for its operator, and the agent for the robot.
    timeout --foreground --signal=INT 30 "$twinstep" run "$policy" --endpoint "$endpoint" --velocity "$1" --seconds 8 >"$folder/run.txt" ||
        result=$?
    echo quit >&"${ROBOT[1]}"
    cat <&"${ROBOT[0]}" >/dev/null
    wait "$robot" || true
    kill "$fake" && wait "$fake" || true
    return "$result"
}

walk 0.5,0,0 "$folder/first.mcap"
walk 0.2,0.2,0.4 "$folder/second.mcap"

"$twinstep" diagnose "$folder/first.mcap" --out "$folder/diagnosis"
for model in nominal.toml diagnosis/extended.toml; do
    echo "errors on the second walk with $model:"
    "$twinstep" evaluate --model "$folder/$model" "$folder/second.mcap"
done

echo "the policy in a simulation of the extended model:"
coproc SERVER {
    exec "$twinstep" serve --model "$folder/diagnosis/extended.toml" --listen tcp/127.0.0.1:0 --until-stdin-closes
}
read -r _ endpoint <&"${SERVER[0]}"
"$twinstep" run "$policy" --endpoint "$endpoint" --velocity 0.5,0,0 --seconds 8
kill "$SERVER_PID"
