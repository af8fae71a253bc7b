#!/usr/bin/env bash
# Follows README.md as a user who has just cloned the repository: HEAD in an empty directory with a space in its path, an
# empty home, no caches and no virtual environments; as a new user if run by root. Only the Rust toolchain is copied.
# Prints how long each step took, and fails if a step fails or exceeds its limit. Arguments are passed to
# `cargo xtask test`.
set -euo pipefail
cd "$(dirname "$0")/.."

# No space in TMPDIR: the compiler that PyTorch runs on files in it cannot handle one.
folder=$(mktemp -d "${TMPDIR:-/tmp}/fresh-machine-XXXXXX")
checkout="$folder/endless gym"
user=
# Called when the script ends.
# shellcheck disable=SC2329
clean() {
    if [[ -n $user ]]; then
        pkill -KILL -u "$user" || true
        userdel "$user"
    fi
    rm -rf "$folder"
}
trap clean EXIT

mkdir "$folder/home" "$folder/tmp"
git clone --quiet --no-hardlinks . "$checkout"
mkdir "$folder/toolchain"
sysroot=$(rustc --print sysroot)
cp -a "$sysroot/bin" "$sysroot/lib" "$folder/toolchain"

as_user=()
if [[ $(id -u) == 0 ]]; then
    user=endless-fresh-$$
    useradd --no-create-home --home-dir "$folder/home" "$user"
    chown -R "$user:" "$folder"
    as_user=(setpriv --reuid "$user" --regid "$user" --init-groups)
fi

# Keep the machine's network settings; everything else is new.
environment=("HOME=$folder/home" "USER=${user:-$(id -un)}" "LANG=C.UTF-8" "TMPDIR=$folder/tmp")
environment+=("PATH=$folder/toolchain/bin:/usr/local/bin:/usr/bin:/bin")
for name in http_proxy https_proxy no_proxy HTTP_PROXY HTTPS_PROXY NO_PROXY PIP_CERT PIP_INDEX_URL SSL_CERT_FILE CI; do
    [[ -n ${!name:-} ]] && environment+=("$name=${!name}")
done

# step SECONDS COMMAND...: runs it as the user in the checkout, SECONDS long at most.
report=()
step() {
    local limit=$1 start=$SECONDS status=0
    shift
    printf '\n==> %s (at most %s s)\n' "$*" "$limit"
    (cd "$checkout" && exec timeout "$limit" "${as_user[@]}" env -i "${environment[@]}" "$@") || status=$?
    report+=("$(printf '%5s s of %5s  exit status %3s  %s' "$((SECONDS - start))" "$limit" "$status" "$*")")
    return "$status"
}

failed=0
step 180 cargo run --release || failed=1
step 900 cargo xtask test "$@" || failed=1
step 1800 cargo xtask dist || failed=1
wheels=("$checkout"/target/dist/endless_gym-*.whl)
step 60 python3 -m venv "$folder/venv" || failed=1
step 10 "$folder/venv/bin/python" -m pip install --quiet "${wheels[0]}" || failed=1
step 60 "$folder/venv/bin/python" -c 'import endless_gym; endless_gym.specs' || failed=1

printf '\n%s\n' "${report[@]}"
exit "$failed"
