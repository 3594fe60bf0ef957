/* The heater's dead-man: permission, relay timer, guard, a second master on the bus, and a program that is stopped,
   killed or started again at any instant. One call of second() is one second; what happens within it comes in any order.

   Times in s, given by -D from the program's own settings (test_dead_man_model.py):
   HOLD    a timed-on of the relay          RENEW   between two of them
   LATE    a look of the guard counts       STALE   a reading counts
   LOOK    between two looks without permission, of the relays
   BUS     a command may be on its way

   Left out: the regulator's own limits, the thermal cut-out, and what a second master does to the regulator. Assumed: a
   timed-on replaces a steady one, and begins again when it comes again (the test of the timer at each start). */

/* Heat after the last look of a guard. Once HOLD would do, but for a program that is stopped between asking the guard and
   sending, and goes on for an instant later. */
#ifndef BOUND
#define BOUND (2 * HOLD + LATE + BUS)
#endif
#define INTRUDED (LOOK + BUS + 2)         /* a relay that another master has switched on */
#define UP(age, most) age = (age < most -> age + 1 : most)

mtype = { RUNNING, STOPPED, DEAD };
mtype program = RUNNING;

bool granted = false, on = false, foreign = false;  /* permission; the relay; whether another master switched it on */
byte left = 0;                            /* s of a timed-on, 0 without one */
byte way = 0, off_way = 0;                /* a timed-on, and an off, on their way: s that are left of BUS, and 1 */
bool hung = false;                        /* the guard looks no more, though the program runs */
bool checked = false;                     /* may_permit was asked, and the timed-on is not sent yet */
byte looked = LATE + 1, read_ = STALE + 1, renewed = 0, supervised = 0;
bool polled = false, guarded = false, kept = false;  /* done in this second */
byte unguarded = 0, intruded = 0;         /* s of heat since the last look; s that a stranger's relay was left on */

inline send_off() { off_way = (off_way -> off_way : BUS + 1) }

inline revoke() { granted = false; send_off() }

inline arrive_on() {
  on = true; foreign = false; way = 0;
#ifdef NO_TIMER
  left = 0
#else
  left = HOLD
#endif
}

inline arrive_off() { on = false; foreign = false; left = 0; off_way = 0; intruded = 0 }

inline look() {                           /* of the guard: it awaits nothing */
  guarded = true; looked = 0; unguarded = 0;
  if
  :: granted && read_ > STALE -> revoke()
  :: else
  fi
}

#ifdef NO_LATE
#define MAY_PERMIT (granted)
#else
#define MAY_PERMIT (granted && looked <= LATE && read_ <= STALE)
#endif

inline keep() {                           /* of the keeper, each second: it may be stopped between asking and sending */
  kept = true;
  if
  :: granted && renewed >= RENEW && MAY_PERMIT -> checked = true; renewed = 0
  :: !granted && supervised >= LOOK ->
     supervised = 0;
     if
     :: on -> send_off()
     :: else
     fi
  :: else
  fi
}

inline second() {
  if
  :: left > 0 -> left--;
     if
     :: left == 0 && !foreign -> on = false
     :: else
     fi
  :: else
  fi;
  if :: way > 1 -> way-- :: way == 1 -> arrive_on() :: else fi;
  if :: off_way > 1 -> off_way-- :: off_way == 1 -> arrive_off() :: else fi;
  if
  :: on && !foreign -> UP(unguarded, 255)
  :: else
  fi;
  if
  :: on && foreign && program == RUNNING && !granted -> UP(intruded, 255)
  :: else -> intruded = 0
  fi;
  UP(looked, LATE + 1); UP(read_, STALE + 1); UP(renewed, RENEW); UP(supervised, LOOK);
  polled = false; guarded = false; kept = false;
  assert(unguarded <= BOUND);
  assert(intruded <= INTRUDED)
}

active proctype Stand() {
  do
  :: atomic { program == RUNNING && !polled -> polled = true;
       if :: read_ = 0 :: skip fi }                     /* the sensor answers, or does not */
  :: atomic { program == RUNNING && !guarded && !hung -> look() }
  :: atomic { program == RUNNING && (guarded || hung) && !kept -> keep() }
  :: atomic { program == RUNNING && !hung -> hung = true }
  :: atomic { program == RUNNING && checked -> checked = false; way = BUS + 1 }
  :: atomic { program == RUNNING && !granted && guarded && looked == 0 && read_ <= STALE && !off_way ->
       granted = true; renewed = RENEW }                /* an operator's order, or a plan's */
  :: atomic { program == RUNNING && granted -> revoke() }          /* STOP, a hold, a trip */
  :: atomic { way > 0 -> arrive_on() }                  /* earlier than BUS */
  :: atomic { off_way > 0 && !way -> arrive_off() }     /* commands of one bus keep their order */
  :: atomic { program == RUNNING -> program = STOPPED }
  :: atomic { program == STOPPED -> program = RUNNING }
  :: atomic { program != DEAD -> program = DEAD; checked = false; hung = false; intruded = 0 }
  :: atomic { program == DEAD -> program = RUNNING; granted = false; send_off();  /* started again: all is switched off */
       looked = LATE + 1; read_ = STALE + 1; supervised = 0 }
  :: atomic { !on -> on = true; foreign = true; left = 0 }          /* the second master */
  :: atomic { (program != RUNNING || (polled && (guarded || hung) && kept && !checked)) -> second() }
  od
}
