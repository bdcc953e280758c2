#!/usr/bin/env bash
# Creates a certificate authority for one run, a certificate for the learner's host, and one for each
# other host. zenoh-learner.json5 and zenoh-host.json5 in this folder use them.
#   certificates.sh FOLDER LEARNER HOST...
# LEARNER: the name or address that other hosts connect to. HOST: a name that zenoh-learner.json5
# admits. authority-key.pem can sign further certificates: keep it off all hosts, or delete it.
set -euo pipefail
if [ $# -lt 3 ]; then
    echo "usage: certificates.sh FOLDER LEARNER HOST..." >&2
    exit 2
fi
folder=$1 learner=$2
shift 2
days=365
umask 077
mkdir -p "$folder"
cd "$folder"

openssl ecparam -name prime256v1 -genkey -noout -out authority-key.pem
openssl req -x509 -new -key authority-key.pem -sha256 -days "$days" -subj "/CN=dmprl run" \
    -addext "basicConstraints=critical,CA:TRUE" -out authority.pem

# certificate FILE COMMON_NAME ALTERNATIVE_NAME
certificate() {
    openssl ecparam -name prime256v1 -genkey -noout | openssl pkcs8 -topk8 -nocrypt -out "$1-key.pem"
    openssl req -new -key "$1-key.pem" -subj "/CN=$2" |
        openssl x509 -req -CA authority.pem -CAkey authority-key.pem -CAcreateserial -sha256 \
            -days "$days" -out "$1.pem" 2>/dev/null -extfile <(
            echo "basicConstraints=CA:FALSE"
            echo "subjectAltName=$3"
        )
}

case $learner in
*[!0-9.]*) certificate learner "$learner" "DNS:$learner" ;;
*) certificate learner "$learner" "IP:$learner" ;;
esac
for host in "$@"; do
    certificate "$host" "$host" "DNS:$host"
done
