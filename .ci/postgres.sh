# Start a throw-away PostgreSQL server on loopback; sourced, never run:
#
#     . .ci/postgres.sh && python -m pytest tests/contract/test_store.py tests/slow/test_store_postgres.py
#
# Exports its SQLAlchemy URL in DENGINE_TEST_POSTGRES. Installs PostgreSQL by apt-get where it is missing and this is
# root. The server stops, and its directory goes, when the sourcing shell exits or calls `dengine_postgres_stop`.
# An EXIT trap that was set before is kept and runs afterwards.
# shellcheck shell=bash

dengine_postgres_bin() {
    local initdb
    initdb=$(command -v initdb || find /usr/lib/postgresql -path '*/bin/initdb' 2>/dev/null | sort -V | tail -n 1)
    [ -n "$initdb" ] && dirname "$(readlink -f "$initdb")"
}

# initdb refuses root: as root, work as the user `postgres` that the package brings.
dengine_postgres_as() {
    if [ "$(id -u)" = 0 ]; then runuser -u postgres -- "$@"; else "$@"; fi
}

dengine_postgres_install() {
    [ "$(id -u)" = 0 ] || { echo "PostgreSQL is missing; install it, or run this as root" >&2; return 1; }
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq postgresql; } >&2
}

dengine_postgres_stop() {
    [ -n "${dengine_postgres_dir:-}" ] || return 0
    dengine_postgres_as "$dengine_postgres_bin/pg_ctl" -D "$dengine_postgres_dir/data" -m immediate stop >/dev/null 2>&1
    rm -rf "$dengine_postgres_dir"
    dengine_postgres_dir=
    unset DENGINE_TEST_POSTGRES
}

dengine_postgres_start() {
    local port
    dengine_postgres_bin=$(dengine_postgres_bin) || dengine_postgres_install || return 1
    dengine_postgres_bin=$(dengine_postgres_bin) || return 1
    dengine_postgres_dir=$(mktemp -d /tmp/dengine-postgres.XXXXXX) || return 1
    eval "set -- $(trap -p EXIT)"  # trap -- COMMAND EXIT, quoted by the shell; nothing where there is none
    # shellcheck disable=SC2064  # the earlier trap is meant to be read now
    trap "dengine_postgres_stop; ${3:-}" EXIT
    [ "$(id -u)" != 0 ] || chown postgres "$dengine_postgres_dir"
    port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])') || return 1
    (
        cd "$dengine_postgres_dir" || exit 1
        dengine_postgres_as "$dengine_postgres_bin/initdb" -D data -U dengine -A trust -E UTF8 --no-sync
        dengine_postgres_as "$dengine_postgres_bin/pg_ctl" -D data -w -l "$dengine_postgres_dir/log" \
            -o "-c listen_addresses=127.0.0.1 -p $port -k $dengine_postgres_dir" start
        dengine_postgres_as "$dengine_postgres_bin/createdb" -h 127.0.0.1 -p "$port" -U dengine dengine
    ) >"$dengine_postgres_dir.out" 2>&1 || { cat "$dengine_postgres_dir.out" >&2; rm -f "$dengine_postgres_dir.out"; return 1; }
    rm -f "$dengine_postgres_dir.out"
    export DENGINE_TEST_POSTGRES="postgresql+psycopg://dengine@127.0.0.1:$port/dengine"
    echo "$DENGINE_TEST_POSTGRES"
}

dengine_postgres_start
