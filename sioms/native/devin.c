/* devin for the usual line: text out of readings that are in shared memory, without an interpreter.
 *
 * Whatever is not usual (a long option, a path, a refusal, a gateway) is left to the tool in Python, which is
 * the reference: this program then becomes the command in its own arguments, before it has written anything. What it
 * shares with that tool (layout of pages and records, messages, options, formats) is in what sioms.tools.compiled puts
 * before this text and attach.c when they are compiled. Why so: docs/decisions/0285.
 */
enum { MOST_TARGETS = 32 };

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

/* ---- the command line ------------------------------------------------------------------------ */

struct target {
    const char *name;
    struct flags flags;
    char opened[MOST_NAME + 16], device[MOST_NAME];
    const uint8_t *page;
    uint8_t *raw;
    int64_t *channels;
    int64_t count, low, high, bit, class;
    int lines, fields;
    const struct field *field[8];
};

static struct target targets[MOST_TARGETS + 1]; /* after the last: flags that nothing follows */
static struct flags all;                        /* of the line */
static int target_count, timed;

static void take_line(char **words)
{
    for (; *words; words++) {
        const char *word = *words;
        struct target *next = &targets[target_count];
        if (word[0] == '-' && word[1] != '-' && !is_numeric(word)) {
            take_group(word + 1, &next->flags, &all);
            continue;
        }
        if (target_count == MOST_TARGETS || !is_plain_name(word))
            leave_to_python();
        next->name = word;
        target_count++;
    }
    timed = all.given['r'] || all.given['t'] || all.given['L'];
    for (int letter = 0; letter < 128; letter++)
        if (targets[target_count].flags.given[letter] && !(letter == 'N' && timed))
            leave_to_python();
    if (!target_count)
        leave_to_python();
}

/* Choose structures and columns; whoever names one that there is not hears of it from the tool in Python. */
static void choose(struct target *t)
{
    const int *given = t->flags.given;
    const char *choice = timed ? "pvfm" : "pvfmN";
    int some = 0;
    if (given['V'] && !timed)
        leave_to_python();
    choose_channels(&t->flags, t->count, &t->low, &t->high);
    for (const char *c = choice; *c; c++)
        some |= given[(int)*c];
    t->lines = !timed && (!some || given['N']);
    for (const struct field *f = FIELDS; f->letter; f++)
        if (f->class == t->class && (!some || given[(int)f->letter]))
            t->field[t->fields++] = f;
}

/* ---- opening ------------------------------------------------------------------------------------ */

static void open_target(int sock, struct target *t)
{
    struct message m;
    int fds[8], fd_count;
    char name[MOST_NAME + 16];
    size_t length = strlen(t->name), end = sizeof READONLY - 1;
    int is_companion = length >= end && !strcmp(t->name + length - end, READONLY);
    snprintf(name, sizeof name, "%s%s", t->name, is_companion ? "" : READONLY);
    int refused = ask_open(sock, name, &m, fds, &fd_count);
    if (refused == ENOENT && !is_companion)
        refused = ask_open(sock, t->name, &m, fds, &fd_count);
    struct stat found;
    if (refused || fd_count != 3 || fstat(fds[0], &found) || take_array(&m) != 5)
        leave_to_python();
    pass(&m, 0); /* handle */
    if (take_array(&m) != NODE_INFO)
        leave_to_python();
    take_text(&m, t->opened, sizeof t->opened);
    t->class = take_integer(&m);
    pass(&m, 0); /* read only */
    t->count = take_array(&m);
    for (int64_t i = 0; i < t->count; i++)
        pass(&m, 0); /* a channel */
    for (int i = 0; i < 3; i++)
        pass(&m, 0); /* bit, rate, capacity */
    take_text(&m, t->device, sizeof t->device);
    pass(&m, 0); /* driver */
    pass(&m, 0); /* version */
    if (take_array(&m) != t->count || !t->count)
        leave_to_python();
    t->channels = take(t->count * sizeof *t->channels);
    for (int64_t i = 0; i < t->count; i++)
        t->channels[i] = take_integer(&m);
    t->bit = take_integer(&m);
    t->page = mmap(NULL, found.st_size, PROT_READ, MAP_SHARED, fds[0], 0);
    if (t->page == MAP_FAILED || found.st_size < PAGE_HEADER)
        leave_to_python();
    const struct page *page = (const struct page *)t->page;
    uint64_t size = page->slot_size;
    if (memcmp(page->magic, MAGIC, sizeof page->magic) || page->version != PAGE_VERSION
        || PAGE_HEADER + page->slots * size > (uint64_t)found.st_size
        || SLOT_HEADER + UINT64_C(8) * page->fields * page->channels > size)
        leave_to_python();
    for (int64_t i = 0; i < t->count; i++)
        if (t->channels[i] < 0 || t->channels[i] >= page->channels)
            leave_to_python();
    t->raw = take(size);
}

/* ---- readings ---------------------------------------------------------------------------------- */

static _Noreturn void unreadable(const struct target *t, uint32_t state, const char *reason)
{
    char text[2048];
    size_t device = strlen(t->device);
    const char *what = "its device is in fault";
    for (size_t i = 0; i < sizeof STATES / sizeof *STATES; i++)
        if (STATES[i].state == state)
            what = STATES[i].text;
    if (!strncmp(reason, t->device, device) && !strncmp(reason + device, ": ", 2))
        reason += device + 2;
    snprintf(text, sizeof text, "read %s: %s: %s", t->opened, what, *reason ? reason : "no reason given");
    fail(text);
}

static void check(const struct target *t, const struct page *page, int64_t now)
{
    uint32_t driver = __atomic_load_n(&page->driver_state, __ATOMIC_ACQUIRE);
    uint32_t daemon = __atomic_load_n(&page->daemon_state, __ATOMIC_ACQUIRE);
    int64_t age = now - (int64_t)__atomic_load_n(&page->alive_ns, __ATOMIC_ACQUIRE);
    char raw[sizeof page->reason + 1] = "", reason[4 * sizeof raw];
    if (driver == GOOD && daemon == GOOD && age <= (int64_t)page->lease_ns)
        return;
    memcpy(raw, page->reason, sizeof page->reason);
    put_printable(reason, raw);
    if (daemon != GOOD)
        unreadable(t, daemon, reason);
    if (driver != GOOD)
        unreadable(t, driver, reason);
    snprintf(reason, sizeof reason, "its driver has not ticked for %.3f s (lease %.3f s)", age / 1e9,
             page->lease_ns / 1e9);
    unreadable(t, STALE, reason);
}

/* Copy the newest snapshot; the writer may lap us meanwhile, and clears the number before it writes. */
static void read_latest(struct target *t)
{
    const struct page *page = (const struct page *)t->page;
    check(t, page, now_ns());
    for (;;) {
        uint64_t number = __atomic_load_n(&page->head, __ATOMIC_ACQUIRE);
        if (!number)
            unreadable(t, STARTING, "nothing published yet");
        const uint8_t *slot = t->page + PAGE_HEADER + (number & (page->slots - 1)) * page->slot_size;
        if (__atomic_load_n((const uint64_t *)slot, __ATOMIC_ACQUIRE) != number)
            continue;
        memcpy(t->raw, slot, page->slot_size);
        __atomic_thread_fence(__ATOMIC_ACQUIRE);
        if (__atomic_load_n((const uint64_t *)slot, __ATOMIC_RELAXED) == number)
            return;
    }
}

static char *put_value(char *at, const struct target *t, const struct field *f, int64_t channel)
{
    const struct page *page = (const struct page *)t->page;
    const uint8_t *place = t->raw + SLOT_HEADER + 8 * (f->row * (int64_t)page->channels + t->channels[channel]);
    int64_t whole;
    double real;
    if (f->real) {
        memcpy(&real, place, 8);
        if (t->class == ANALOG) {
            memcpy(&whole, place + 8 * (FLAGS - f->row) * (int64_t)page->channels, 8);
            if (whole & INVALID)
                return at + sprintf(at, "nan");
        }
        return at + (isnan(real) ? sprintf(at, "nan") : sprintf(at, "%.*e", f->digits, real));
    }
    memcpy(&whole, place, 8);
    if (t->class == BINARY && t->bit >= 0)
        whole = whole >> t->bit & 1;
    return at + sprintf(at, "%lld", (long long)whole);
}

static char *put_rows(char *at, struct target *t)
{
    read_latest(t);
    for (int64_t channel = t->low; channel <= t->high; channel++) {
        if (t->lines)
            at += sprintf(at, "%lld", (long long)channel);
        for (int i = 0; i < t->fields; i++) {
            if (t->lines)
                *at++ = ' ';
            at = put_value(at, t, t->field[i], channel);
            if (!t->lines)
                *at++ = ' ';
        }
        if (t->lines)
            *at++ = '\n';
    }
    return at;
}

static void write_all(const char *data, size_t size)
{
    while (size) {
        ssize_t out = write(1, data, size);
        if (out >= 0) {
            data += out;
            size -= out;
        } else if (errno == EAGAIN) {
            struct pollfd ready = {1, POLLOUT, 0};
            poll(&ready, 1, -1);
        } else if (errno != EINTR) {
            char text[256];
            int n = snprintf(text, sizeof text, "write standard output: ");
            snprintf(text + n, sizeof text - n, "%s", strerror(errno));
            for (char *c = text; *c; c++)
                if (*c >= 'A' && *c <= 'Z')
                    *c += 'a' - 'A';
            fail(text);
        }
    }
}

/* Sample k is taken k periods after the first; one whose time has passed is left out, its number with it. */
static void repeat(char *text, int numbered)
{
    int64_t period = nearbyint((all.given['t'] ? all.value['t'] : 1.0) * 1e9), start = now_ns(), number = 0;
    double count = all.given['L'] ? all.value['L'] : DEFAULT_COUNT;
    if (period < 1)
        period = 1;
    prctl(PR_SET_TIMERSLACK, 1);
    for (double printed = 0; printed != count; printed++) {
        if (printed) {
            int64_t due = start + number * period;
            struct timespec until = {due / 1000000000, due % 1000000000};
            while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
                ;
        }
        char *at = text;
        if (numbered)
            at += sprintf(at, "%.6f %lld ", (now_ns() - start) / 1e9, (long long)number);
        char *values = at;
        for (int i = 0; i < target_count; i++)
            at = put_rows(at, &targets[i]);
        if (numbered) {
            while (at > values && at[-1] == ' ')
                at--;
            *at++ = '\n';
        }
        write_all(text, at - text);
        int64_t passed = (now_ns() - start) / period;
        number = passed > number ? passed : number + 1;
    }
}

int main(int argc, char **argv)
{
    be_tool(argc, argv);
    struct message m;
    int fds[8], fd_count, sock = connect_to_daemon(), numbered = 0;
    if (ask(sock, HELLO, sizeof HELLO, HELLO_NUMBER, &m, fds, &fd_count))
        leave_to_python();
    size_t room = 128;
    for (int i = 0; i < target_count; i++) {
        open_target(sock, &targets[i]);
        choose(&targets[i]);
        numbered |= targets[i].flags.given['N'];
        room += (targets[i].high - targets[i].low + 1) * (targets[i].fields + 1) * 32;
    }
    char *text = take(room), *at = text;
    if (timed) {
        repeat(text, numbered || targets[target_count].flags.given['N']);
        return 0;
    }
    for (int i = 0; i < target_count; i++)
        at = put_rows(at, &targets[i]);
    write_all(text, at - text);
    return 0;
}
