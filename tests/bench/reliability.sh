#!/usr/bin/env bash
# The long runs behind docs/RELIABILITY.md: tests/bench/reliability.sh cuts|kills|damage|fuzz|corpora|soak [N]
#   cuts N     cuts of the power (default 1000000)
#   kills N    kill -9 of the service under a recording load (default 200)
#   damage N   damaged files (default 10000)
#   fuzz N     inputs of every target (default 10000000); TARGETS="NAME ..." chooses, SEED=N varies them
#   corpora    puts what fuzzing has found into tests/data/fuzz, as few inputs as reach all that it reaches
#   soak N     minutes under the load of 2,000 sessions (default 60), the server on a core of its own
set -euo pipefail
cd "$(dirname "$0")/../.."
test() { cargo test --release --locked -p mazeway-tests --test "$1" "$2" -- --nocapture; }
fuzz() {
    # libFuzzer is guided by the edges that our own crates take, which a stable compiler counts.
    local host directory=target/fuzz/build
    host=$(rustc -vV | sed -n 's/^host: //p')
    CARGO_TARGET_DIR=$directory RUSTC_WORKSPACE_WRAPPER=$PWD/tests/bench/fuzz/instrument \
        RUSTFLAGS='--cfg fuzzing --cfg fuzzing_libfuzzer' \
        cargo build --profile fuzz --locked --target "$host" -p mazeway-bench-fuzz
    # shellcheck disable=SC2086
    "$directory/$host/fuzz/fuzz" "$@" ${TARGETS:-}
}
case "${1:-}" in
    cuts) MAZEWAY_CUTS=${2:-1000000} test crash what_was_acknowledged ;;
    kills) MAZEWAY_KILLS=${2:-200} test kill what_was_acknowledged ;;
    damage) MAZEWAY_DAMAGES=${2:-10000} test damage whatever_page ;;
    fuzz) fuzz --runs "${2:-10000000}" --seed "${SEED:-1}" ;;
    corpora) fuzz --keep ;;
    soak) cargo run --release --locked -p mazeway-bench-soak -- --minutes "${2:-60}" --pinned ;;
    *)
        sed -n '2,8s/^# //p' "$0" >&2
        exit 2
        ;;
esac
