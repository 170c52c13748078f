#!/usr/bin/env bash
# Runs a command beside a SLURM of one node, which it starts on loopback and stops afterwards: make test-slurm
#   bash scripts/with_slurm.sh COMMAND...
# Needs root on Debian or Ubuntu: it installs the distribution's own packages where they are missing (they stay), and
# writes /etc/slurm/slurm.conf and gres.conf (they go). A machine that has a SLURM of its own is left alone. The node
# claims 16 processors, 64 GB and a GPU, whatever there is: the trial is of scheduling, not of speed.
set -euo pipefail

refuse() { echo "drivesplat: $1" >&2; exit 1; }

[ $# -gt 0 ] || refuse "with_slurm.sh: say what to run"
[ "$(id -u)" = 0 ] || refuse "a SLURM can only be started by root: run this in a container, or on a machine of your own"
[ ! -e /etc/slurm/slurm.conf ] || refuse "this machine has a SLURM (/etc/slurm/slurm.conf); run the command by itself"

if ! command -v slurmctld slurmd sbatch munged >/dev/null; then
    command -v apt-get >/dev/null || refuse "slurmctld, slurmd, sbatch and munged are not here, and there is no apt-get"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends slurmctld slurmd slurm-client munge
fi

folder=$(mktemp -d /tmp/slurm-trial-XXXXXX)
node=$(hostname -s)
stop() {
    for daemon in slurmd slurmctld munged; do
        [ -s "$folder/$daemon.pid" ] || continue
        pid=$(cat "$folder/$daemon.pid")
        kill "$pid" 2>/dev/null || continue
        for _ in $(seq 100); do # slurmctld writes its state down before it ends
            kill -0 "$pid" 2>/dev/null || break
            sleep 0.1
        done
    done
    rm -f /etc/slurm/slurm.conf /etc/slurm/gres.conf
    rm -rf "$folder"
}
trap stop EXIT
trap 'exit 130' INT TERM

chmod 755 "$folder"
mkdir -m 755 "$folder/munge" "$folder/log" "$folder/spool"
mkdir -m 700 "$folder/state"
mkdir -p /etc/slurm
(umask 077 && head -c 1024 /dev/urandom > "$folder/munge/key")
cat > /etc/slurm/slurm.conf <<CONF
ClusterName=trial
SlurmctldHost=$node(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
AuthType=auth/munge
AuthInfo=socket=$folder/munge/socket
SlurmUser=root
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldLogFile=$folder/log/slurmctld.log
SlurmdLogFile=$folder/log/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SlurmdParameters=config_overrides
GresTypes=gpu
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
MinJobAge=300
NodeName=$node NodeAddr=127.0.0.1 CPUs=16 RealMemory=64000 Gres=gpu:1 State=UNKNOWN
PartitionName=main Nodes=$node Default=YES MaxTime=INFINITE State=UP
CONF
printf 'AutoDetect=off\nName=gpu File=/dev/null\n' > /etc/slurm/gres.conf

munged --force --socket="$folder/munge/socket" --key-file="$folder/munge/key" --log-file="$folder/munge/log" \
    --pid-file="$folder/munged.pid" --seed-file="$folder/munge/seed"
slurmctld
slurmd
for _ in $(seq 30); do
    [ "$(sinfo --noheader --format=%t 2>/dev/null)" != idle ] || break
    sleep 1
done
[ "$(sinfo --noheader --format=%t)" = idle ] || { tail -n 20 "$folder"/log/slurmctld.log >&2; refuse "SLURM does not come up"; }
"$@"
