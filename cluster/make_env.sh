#!/bin/sh
# Writes cluster/.env with fresh random secrets for compose.yaml; an existing one is kept.
set -eu
file=${1:-$(dirname "$0")/.env}
if [ -e "$file" ]; then
  echo "$file is there already; delete it for new secrets (the databases keep the old ones)" >&2
  exit 1
fi
umask 077
secret() { od -An -N24 -tx1 /dev/urandom | tr -d ' \n'; }
cat >"$file" <<EOF
RAY_AUTH_TOKEN=$(secret)
POSTGRES_PASSWORD=$(secret)
MLFLOW_TRACKING_USERNAME=music
MLFLOW_TRACKING_PASSWORD=$(secret)
MLFLOW_FLASK_SERVER_SECRET_KEY=$(secret)
MUSIC_RLLIB_SERVE_TOKEN=$(secret)
GRAFANA_PASSWORD=$(secret)
EOF
echo "wrote $file"
