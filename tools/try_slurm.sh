#!/bin/sh
# Start a Slurm of one node on this machine, to try `smplxpp batch --slurm` on; as root, without systemd, cgroups or accounting.
#
#     apt-get install -y --no-install-recommends slurmctld slurmd slurm-client munge
#     sh tools/try_slurm.sh FOLDER [start | stop]
#
# Logs and state lie in FOLDER; jobs that are preempted or whose node is lost are queued again. Partition `urgent` preempts.
set -eu
place=$(mkdir -p "$1" && cd "$1" && pwd)
if [ "${2:-start}" = stop ]; then
    for name in slurmd slurmctld munged; do
        [ ! -f "$place/$name.pid" ] || kill "$(cat "$place/$name.pid")" || true
    done
    exit
fi
mkdir -p "$place/state" "$place/spool" /etc/slurm /run/munge
cat > /etc/slurm/slurm.conf <<END
ClusterName=try
SlurmctldHost=localhost
SlurmUser=root
AuthType=auth/munge
CryptoType=crypto/munge
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
SchedulerParameters=sched_interval=2,bf_interval=5
KillWait=10
SlurmdTimeout=30
ReturnToService=2
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MailProg=/bin/true
StateSaveLocation=$place/state
SlurmdSpoolDir=$place/spool
SlurmctldLogFile=$place/slurmctld.log
SlurmdLogFile=$place/slurmd.log
SlurmctldPidFile=$place/slurmctld.pid
SlurmdPidFile=$place/slurmd.pid
NodeName=localhost CPUs=$(nproc) State=UNKNOWN
PartitionName=main Nodes=localhost Default=YES MaxTime=INFINITE State=UP PriorityTier=1
PartitionName=urgent Nodes=localhost MaxTime=INFINITE State=UP PriorityTier=10
END
# The other two read the key that Debian's package made.
chown munge: /run/munge "$place"
chmod 755 "$place"
munge -n >/dev/null 2>&1 || su -s /bin/sh munge -c "/usr/sbin/munged --pid-file=$place/munged.pid"
slurmctld
slurmd -N localhost
until sinfo --noheader --states=idle,mix,alloc | grep -q .; do sleep 1; done
sinfo
