#!/bin/sh
# MLflow with basic authentication. All secrets come from the environment:
#   MLFLOW_BACKEND_STORE_URI        database of the runs, e.g. postgresql://mlflow:...@postgres/mlflow
#   MLFLOW_AUTH_DATABASE_URI        database of the users (may be the same server's)
#   MLFLOW_ADMIN_USERNAME, MLFLOW_ADMIN_PASSWORD   the first user; at least 12 characters
#   MLFLOW_FLASK_SERVER_SECRET_KEY  signs forms; the same for all servers
# and, optional: MLFLOW_HOST (127.0.0.1), MLFLOW_PORT (5000), MLFLOW_ARTIFACTS (./mlartifacts),
# MLFLOW_SERVER_ALLOWED_HOSTS (host names that clients may use).
set -eu

for name in MLFLOW_BACKEND_STORE_URI MLFLOW_AUTH_DATABASE_URI MLFLOW_ADMIN_USERNAME \
    MLFLOW_ADMIN_PASSWORD MLFLOW_FLASK_SERVER_SECRET_KEY; do
  eval "value=\${$name:-}"
  [ -n "$value" ] || { echo "mlflow-server: $name must be set" >&2; exit 2; }
done
[ "${#MLFLOW_ADMIN_PASSWORD}" -ge 12 ] || {
  echo "mlflow-server: MLFLOW_ADMIN_PASSWORD must have at least 12 characters" >&2
  exit 2
}
case "$MLFLOW_ADMIN_PASSWORD$MLFLOW_AUTH_DATABASE_URI" in
  *%*) percent=1 ;;
  *) percent=0 ;;
esac
# configparser reads the file; in it, % begins a reference.
[ "$percent" = 0 ] || {
  echo "mlflow-server: MLFLOW_ADMIN_PASSWORD and MLFLOW_AUTH_DATABASE_URI must have no %" >&2
  exit 2
}

# SQLAlchemy 2.1 uses psycopg 3 for postgresql://, but psycopg2 is installed.
for name in MLFLOW_BACKEND_STORE_URI MLFLOW_AUTH_DATABASE_URI; do
  eval "value=\$$name"
  case "$value" in
    postgresql://*) export "$name=postgresql+psycopg2${value#postgresql}" ;;
  esac
done

# Without the cache every request hashes the password, which takes most of its time.
# Readable for this user only, and removed when the server ends.
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT INT TERM
umask 077
cat >"$folder/basic_auth.ini" <<EOF
[mlflow]
default_permission = NO_PERMISSIONS
database_uri = $MLFLOW_AUTH_DATABASE_URI
admin_username = $MLFLOW_ADMIN_USERNAME
admin_password = $MLFLOW_ADMIN_PASSWORD
authorization_function = mlflow.server.auth:authenticate_request_basic_auth
auth_cache_ttl_seconds = 60
EOF
export MLFLOW_AUTH_CONFIG_PATH="$folder/basic_auth.ini"
# Tracking needs no job consumers, which would take 2.5 GB of memory.
export MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false

mlflow server --app-name basic-auth \
  --host "${MLFLOW_HOST:-127.0.0.1}" --port "${MLFLOW_PORT:-5000}" --workers "${MLFLOW_WORKERS:-2}" \
  --serve-artifacts --artifacts-destination "${MLFLOW_ARTIFACTS:-./mlartifacts}" \
  ${MLFLOW_SERVER_ALLOWED_HOSTS:+--allowed-hosts "$MLFLOW_SERVER_ALLOWED_HOSTS"} &
server=$!
trap 'kill "$server" 2>/dev/null; wait "$server"; rm -rf "$folder"; exit 143' INT TERM
wait "$server"
